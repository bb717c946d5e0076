"""Studies that run the library many times and report: chart, stability, design and demo."""
