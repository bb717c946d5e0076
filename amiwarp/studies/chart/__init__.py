"""What each bit of speed costs: compensation and calibration, measured every sensible way on one recording."""

from amiwarp.studies.chart.charts import Charts, make, simulated

__all__ = ["Charts", "make", "simulated"]
