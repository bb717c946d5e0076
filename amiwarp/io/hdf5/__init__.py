"""HDF5 files: their chunks, access to their datasets through the reading process, and rows of MVSEC and Prophesee."""
