"""Rotation of the camera, and growth of the image as it moves forward."""

import warp as wp

from amiwarp.kernels.camera import NAN, CameraParams, PinholeParams, pixel_to_ray, ray_to_pixel

# Fused multiply-add is off because CPUs and GPUs apply it at different places: results are then bit-identical.
wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.struct
class CameraRotationParams:
    """Angular velocity at time 0 [rad/s], angular acceleration [rad/s²], growth of the image [1/s], and a path."""

    velocity: wp.vec3
    acceleration: wp.vec3
    growth: float
    # Known rotation from time 0 to even times, as axis times angle [rad]; may be empty
    path: wp.array(dtype=wp.vec3)
    path_start: float  # time of the first of them [s]
    path_rate: float  # their number per second [1/s]


@wp.func
def rotation_vector(camera_rotation: CameraRotationParams, time: float) -> wp.vec3:
    """Return the camera's rotation from time 0 to ``time`` [s], as axis times angle [rad]."""
    rotation = camera_rotation.velocity * time + camera_rotation.acceleration * (0.5 * time * time)
    last = camera_rotation.path.shape[0] - 1
    if last < 1:
        return rotation
    place = wp.clamp(
        (time - camera_rotation.path_start) * camera_rotation.path_rate, 0.0, float(last)
    )
    before = wp.min(int(place), last - 1)
    return rotation + wp.lerp(
        camera_rotation.path[before], camera_rotation.path[before + 1], place - float(before)
    )


@wp.func
def undo_camera_rotation(
    camera: CameraParams, xy: wp.vec2, camera_rotation: CameraRotationParams, time: float
) -> wp.vec2:
    """Return the pixel that the scene point seen at ``xy`` at ``time`` [s] has at time 0.

    A camera that moves forward by the share g of all distances sees the image grow by 1 / (1 - g). From g = 1 on, it is
    behind the scene, and pixels are NaN.
    """
    rotation = rotation_vector(camera_rotation, time)
    angle = wp.length(rotation)
    size = 1.0 - camera_rotation.growth * time
    if angle < 1.0e-9 and size == 1.0:
        return xy
    ray = pixel_to_ray(camera, xy)
    ray = wp.quat_rotate(wp.quat_from_axis_angle(rotation / wp.max(angle, 1.0e-9), angle), ray)
    return ray_to_pixel(
        camera, wp.vec3(size * ray[0], size * ray[1], wp.where(size > 0.0, ray[2], -1.0))
    )


@wp.func
def undo_camera_rotation(
    camera: PinholeParams, xy: wp.vec2, camera_rotation: CameraRotationParams, time: float
) -> wp.vec2:
    """Return the pixel at time 0, for a camera without distortion."""
    rotation = rotation_vector(camera_rotation, time)
    angle = wp.length(rotation)
    size = 1.0 - camera_rotation.growth * time
    if angle < 1.0e-9 and size == 1.0:
        return xy
    ray = wp.vec3(
        (xy[0] - camera.cx) * camera.inverse_fx, (xy[1] - camera.cy) * camera.inverse_fy, 1.0
    )
    ray = wp.quat_rotate(wp.quat_from_axis_angle(rotation / wp.max(angle, 1.0e-9), angle), ray)
    scale = wp.where(wp.min(ray[2], size) > 1.0e-6, size / ray[2], NAN)
    return wp.vec2(
        camera.fx * (ray[0] * scale) + camera.cx, camera.fy * (ray[1] * scale) + camera.cy
    )
