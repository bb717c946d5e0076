"""Options of simulations with a fixed set of values."""

from amiwarp.errors import Option


class Optic(Option):
    """What moves the image of a simulated camera.

    Examples
    --------
    >>> Optic("plate")
    <Optic.PLATE: 'plate'>
    """

    WEDGE = "wedge"
    """Rotating wedge prism, which moves near and far points alike."""
    PLATE = "plate"
    """Rotating tilted plane-parallel plate, which moves near points only."""
    VIBRATION = "vibration"
    """No glass: the camera itself vibrates. Its recording has no encoder."""
    MIRROR = "mirror"
    """Mirror with two tilts; an encoder records the angles of its two commands."""
    STEERER = "steerer"
    """Beam steerer of two deflectors; an encoder records the angles of its two commands."""


class Seeing(Option):
    """Method by which the simulator computes the light that each pixel receives from a world."""

    MAPS = "maps"
    """Look up pre-rendered pictures of the world (maps), and blend two successive maps linearly in time.

    A map shows the world without the prism. A new map is rendered after the image has moved by half a pixel.
    """
    RAYS = "rays"
    """Cast rays from every pixel through the prism into the world at every time step: exact, but slow on a CPU."""


class FrameEncoding(Option):
    """Relation between the values of a simulated camera's frames and the light.

    Examples
    --------
    >>> amiwarp.FrameEncoding("linear")
    <FrameEncoding.LINEAR: 'linear'>
    """

    SRGB = "srgb"
    """Values as in picture files and on screens (sRGB, IEC 61966-2-1)."""
    LINEAR = "linear"
    """Values proportional to the light."""
