"""AEDAT files of iniVation and jAER."""
