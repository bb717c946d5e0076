"""Files of plain columns of any layout: NumPy, HDF5, MATLAB, Parquet, and what text shares with them."""
