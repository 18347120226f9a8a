"""The geometry of a calibrated RGB-D camera: the paper's Eq. 8 and its inverse.

The camera's axes are OpenCV's: x right, y down in the image, z forward along the optical axis. Pixels are
continuous: u runs right and v down from the image's upper left corner, so the middle of the pixel in row i and column j
is at (j + 0.5, i + 0.5). Depth is along the optical axis, as an RGB-D sensor gives it and Eq. 8 has it, not along the
ray.
"""

import dataclasses

import numpy as np
from scipy.spatial.transform import Rotation


@dataclasses.dataclass(frozen=True)
class Camera:
    """A pinhole camera without distortion, and its pose.

    Raises:
      ValueError: a size or focal length is not positive, or the rotation is not one.
    """

    width: int
    """Pixels in a row."""
    height: int
    """Pixels in a column."""
    matrix: np.ndarray
    """`[3, 3]`: intrinsics M, pixels."""
    rotation: np.ndarray
    """`[3, 3]`: R of Eq. 8; its columns are the camera's axes (right, down, forward) in the world."""
    position: np.ndarray
    """`[3]`: T of Eq. 8, the optical centre in the world, metres."""

    def __post_init__(self) -> None:
        if self.width < 1 or self.height < 1:
            raise ValueError(f"an image of {self.width} by {self.height} pixels; each must be at least 1")
        if not (self.matrix.shape == (3, 3) and self.matrix[0, 0] > 0 and self.matrix[1, 1] > 0):
            raise ValueError("the intrinsics must be a 3 by 3 matrix with positive focal lengths")
        proper = np.allclose(self.rotation @ self.rotation.T, np.eye(3), atol=1e-6) and np.linalg.det(self.rotation) > 0
        if not proper:
            raise ValueError("the camera's rotation must be a rotation matrix")

    def to_world(self, pixels: np.ndarray, depth: np.ndarray) -> np.ndarray:
        """Returns the positions of pixels in the world, `[..., 3]`, metres, by Eq. 8: P = R (z M⁻¹ [u, v, 1]ᵀ) + T.

        `pixels` are (u, v), `[..., 2]`; `depth`, `[...]`, is z, metres.
        """
        homogeneous = np.concatenate([pixels, np.ones_like(pixels[..., :1])], axis=-1)
        in_camera = np.asarray(depth)[..., None] * (homogeneous @ np.linalg.inv(self.matrix).T)
        return in_camera @ self.rotation.T + self.position

    def to_pixels(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns the pixels (u, v), `[..., 2]`, and depths, `[...]`, of points in the world, `[..., 3]`.

        A point behind the camera has a negative depth, and its pixel means nothing.
        """
        in_camera = (np.asarray(points) - self.position) @ self.rotation
        depth = in_camera[..., 2]
        return (in_camera @ self.matrix.T)[..., :2] / depth[..., None], depth

    def moved(self, rotation: np.ndarray, translation: np.ndarray) -> "Camera":
        """Returns the camera turned and shifted, as by an error of the extrinsic calibration.

        `rotation`, `[3]`, is a rotation vector about the camera's own axes, radians; `translation`, `[3]`, is along the
        world's axes, metres.
        """
        turned = self.rotation @ Rotation.from_rotvec(rotation).as_matrix()
        return dataclasses.replace(self, rotation=turned, position=self.position + translation)


def intrinsics(width: int, height: int, fovy: float) -> np.ndarray:
    """Returns M, `[3, 3]`, of square pixels and a centred optical axis; `fovy` degrees is the view from top to bottom.

    >>> intrinsics(200, 100, 90.0).round(6).tolist()
    [[50.0, 0.0, 100.0], [0.0, 50.0, 50.0], [0.0, 0.0, 1.0]]
    """
    focal = height / 2 / np.tan(np.radians(fovy) / 2)
    return np.array([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])


def look_at(position: np.ndarray, target: np.ndarray, fovy: float, width: int, height: int) -> Camera:
    """Returns a camera at `position`, `[3]`, with `target`, `[3]`, in the middle and the world's z up in the image.

    Raises:
      ValueError: it would look straight up or down, so that no side of the image is up.
    """
    forward = np.asarray(target, float) - position
    right = np.cross(forward, [0.0, 0.0, 1.0])
    if np.linalg.norm(right) < 1e-9 * np.linalg.norm(forward) or not forward.any():
        raise ValueError("the camera must not look straight up or down, nor at where it is; move it a little")
    down = np.cross(forward, right)  # of a right-handed frame
    axes = np.stack([right, down, forward], axis=-1)
    rotation = axes / np.linalg.norm(axes, axis=0)
    return Camera(width, height, intrinsics(width, height, fovy), rotation, np.asarray(position, float))
