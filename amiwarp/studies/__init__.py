"""Studies that run the library many times and report: chart, stability, evaluation, design, data sets and demo."""
