"""Charts of speed against error: compensation and calibration in many settings, measured on one recording."""

from amiwarp.studies.chart.charts import Charts, make, simulated

__all__ = ["Charts", "make", "simulated"]
