"""Native recordings: HDF5 files with the layout of ``docs/reference/recording-format.md``."""
