"""Data sets that are translated by name."""

from amiwarp.errors import Option


class DataSet(Option):
    """Data sets whose motion, or whose file layout, is known.

    Examples
    --------
    >>> amiwarp.DataSet("mvsec").name
    'MVSEC'
    """

    N_CALTECH101 = "n-caltech101"
    """Pictures of Caltech101, or recordings of N-Caltech101 or N-MNIST: three saccades in front of a picture.

    G. Orchard et al., "Converting Static Image Datasets to Spiking Neuromorphic Datasets Using Saccades", Frontiers in
    Neuroscience 9 (2015).
    """
    MVSEC = "mvsec"
    """HDF5 files with pictures and events of the left camera.

    A. Zhu et al., "The Multivehicle Stereo Event Camera Dataset", IEEE Robotics and Automation Letters 3 (2018).
    """
