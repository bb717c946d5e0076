"""A simulated world on a device: its bodies, materials, light sources and sky."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.struct
class Pose:
    """Pose of a body or a camera: transformation from the frame of the body or camera to the world's frame."""

    rotation: wp.mat33
    position: wp.vec3


@wp.struct
class Mover:
    """Mesh of a moving body."""

    mesh: wp.uint64  # id of the Warp mesh, whose vertices are in the body's frame
    first_face: int  # number of the body's first face among the faces of the world
    radius: float  # radius of the bounding sphere [m]
    lower: wp.vec3  # corner of the bounding box with the smallest x, y, z, in the body's frame [m]
    upper: wp.vec3  # corner of the bounding box with the largest x, y, z, in the body's frame [m]


@wp.struct
class Surface:
    """Material of a body."""

    reflectance: float  # fraction of the light that the surface reflects
    emission: float  # luminance that the surface emits
    texel: int  # index of the first texel of the texture pyramid; -1 without a texture
    width: int  # width of the texture [texels]
    height: int  # height of the texture [texels]
    levels: int  # number of levels of the texture pyramid
    instance: int  # instance number of the body


@wp.struct
class Lamp:
    """Point light source."""

    position: wp.vec3  # position in the world's frame [m]
    shadows: int  # 1 if bodies cast shadows in the light of this lamp, else 0


@wp.struct
class World:
    """Geometry, materials and light of a world, at one or more instants.

    A mover is a moving body. The faces of bodies at rest come first, followed by the faces of each mover.
    """

    still: wp.uint64  # id of the Warp mesh of all bodies at rest; 0 if all bodies move
    movers: wp.array(dtype=Mover)  # meshes of the moving bodies
    first_mover: int  # number of the first mover among all bodies
    poses: wp.array2d(dtype=Pose)  # pose of each mover at each instant; axes: instant, mover
    # Centre of each mover's bounding sphere in the world [m]; instant, mover
    centres: wp.array2d(dtype=wp.vec3)
    body: wp.array(dtype=int)  # number of the body of each face
    corners: wp.array(dtype=wp.vec3)  # the three corners of each face, in the frame of its mesh [m]
    uv: wp.array(dtype=wp.vec2)  # texture coordinates at the three corners of each face
    shade: wp.array(dtype=float)  # factor of the reflectance at the three corners of each face
    density: wp.array(dtype=float)  # texels per metre on each face
    surfaces: wp.array(dtype=Surface)  # material of each body
    texels: wp.array(dtype=float)  # texels of all texture pyramids and of the panorama
    ambient: float  # luminance of a white surface in the shade
    sun: wp.vec3  # unit vector towards the sun
    # Luminance that the sun gives to a white surface that faces the sun; 0 without a sun
    sun_light: float
    sun_shadows: int  # 1 if bodies cast shadows in sunlight, else 0
    lamps: wp.array(dtype=Lamp)  # point light sources
    # Intensity of each lamp at each instant; axes: instant, lamp
    lamp_light: wp.array2d(dtype=float)
    sky: float  # luminance of an even sky, or factor of the panorama
    panorama: int  # index of the first texel of the sky's panorama; -1 for an even sky
    panorama_width: int  # width of the panorama [texels]
    panorama_height: int  # height of the panorama [texels]
