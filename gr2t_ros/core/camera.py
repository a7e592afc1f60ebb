# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Camera intrinsics and distortion: a ray for each pixel, a pixel for each point."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from math import atan, degrees, sqrt

import cv2
from numba import njit
import numpy as np
from numpy.typing import NDArray

from ..errors import FrameError

MODELS = ('plumb_bob', 'rational_polynomial', 'equidistant')
_COEFFICIENTS = {'plumb_bob': 5, 'rational_polynomial': 8, 'equidistant': 4}
_PINHOLE, _RADIAL, _EQUIDISTANT = 0.0, 1.0, 2.0
_MAX_ROUND_TRIP = 0.05  # px; pixels that the model cannot invert better have no ray
_MAX_SLOPE = 10.0  # of a ray against the optical axis, 84 degrees: no depth image goes farther


@dataclass(frozen=True)
class Camera:
    """
    A pinhole camera with distortion; pixel centres have integer coordinates.

    :param width: pixels
    :param height: pixels
    :param fx: focal lengths and principal point, pixels
    :param model: one of MODELS, as sensor_msgs/CameraInfo names them
    :param distortion: its coefficients in ROS's (OpenCV's) order; empty: no distortion
    :raises FrameError: if a size or focal length is not positive, that far too short for the size,
        or the distortion unknown
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    model: str = 'plumb_bob'
    distortion: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if self.width <= 0 or self.height <= 0:
            raise FrameError(
                'uncalibrated', f'camera_info is for images of {self.width}x{self.height} pixels: '
                'publish one with the size of the images')
        numbers = (self.fx, self.fy, self.cx, self.cy, *self.distortion)
        if not (self.fx > 0 and self.fy > 0 and np.isfinite(numbers).all()):
            raise FrameError(
                'uncalibrated', f'camera_info has focal length {self.fx:g}, {self.fy:g} px: the '
                'camera is not calibrated; publish a camera_info with a valid K')
        # the density holds what the corners' pixels cover: it would be endless
        slope = max(
            max(abs(c), abs(size - 1 - c)) / f for c, size, f in (
                (self.cx, self.width, self.fx), (self.cy, self.height, self.fy)))
        if slope > _MAX_SLOPE:
            raise FrameError(
                'uncalibrated', f'camera_info has focal length {self.fx:g}, {self.fy:g} px and '
                f'principal point {self.cx:g}, {self.cy:g} px for {self.width}x{self.height} '
                f'pixels: some look more than {degrees(atan(_MAX_SLOPE)):.0f} degrees aside, so '
                'the camera is not calibrated; publish a camera_info with a valid K')
        if any(self.distortion):
            known = _COEFFICIENTS.get(self.model)
            if known is None:
                raise FrameError(
                    'distortion_model', f'camera_info has distortion_model {self.model!r}; '
                    f'known are {", ".join(MODELS)}: publish a rectified image instead')
            if any(self.distortion[known:]):
                raise FrameError(
                    'distortion_model', f'camera_info has {len(self.distortion)} distortion '
                    f'coefficients where {self.model} has {known}: publish a rectified image')

    @classmethod
    def from_camera_info(
        cls,
        width: int,
        height: int,
        K: Sequence[float],
        D: Sequence[float],
        P: Sequence[float],
        model: str,
        *,
        rectified: bool,
        roi: tuple[int, int, int, int] = (0, 0, 0, 0),
        binning: tuple[int, int] = (1, 1),
    ) -> Camera:
        """
        Build the camera of the image that a sensor_msgs/CameraInfo goes with.

        :param width: of the full image, pixels; likewise height
        :param K: 9 numbers, row-major, of the raw image
        :param D: distortion coefficients
        :param P: 12 numbers, row-major, of the rectified image
        :param rectified: whether the image is rectified: then P counts and D does not
        :param roi: x_offset, y_offset, width, height in full pixels; zero width: all of it
        :param binning: full pixels per image pixel in x and y; 0 means 1
        :raises FrameError: see Camera
        """
        # as REP 104 and image_geometry: first the region's offset, then the binning
        if rectified and P[0] > 0:
            fx, fy, cx, cy = P[0], P[5], P[2], P[6]
        else:
            fx, fy, cx, cy = K[0], K[4], K[2], K[5]
        x_offset, y_offset, roi_width, roi_height = roi
        bx, by = max(binning[0], 1), max(binning[1], 1)
        return cls(
            width=(roi_width or width) // bx, height=(roi_height or height) // by,
            fx=float(fx) / bx, fy=float(fy) / by,
            cx=(float(cx) - x_offset) / bx, cy=(float(cy) - y_offset) / by,
            model=model or 'plumb_bob',
            distortion=() if rectified else tuple(float(d) for d in D))

    @cached_property
    def rays(self) -> NDArray[np.float64]:
        """
        Return the rays of all pixels.

        :return: (h, w, 2) float64: the point of pixel (u, v) at depth z is z (a, b, 1), with
            a, b = rays[v, u]; NaN where the distortion cannot be inverted or the ray is too steep
        """
        v, u = np.mgrid[0:self.height, 0:self.width].astype(np.float64)
        rays: NDArray[np.float64] = np.stack(
            [(u - self.cx) / self.fx, (v - self.cy) / self.fy], axis=-1)
        if any(self.distortion):
            pixels = np.stack([u, v], axis=-1).reshape(-1, 1, 2)
            K = np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1.0]])
            if self.model == 'equidistant':
                found = cv2.fisheye.undistortPoints(pixels, K, np.array(self._padded[:4]))
            else:
                # OpenCV 5 gave undistortPoints the criteria that 4 has in a function of its own
                undistort = getattr(cv2, 'undistortPointsIter', cv2.undistortPoints)
                stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-12)
                found = undistort(
                    pixels, K, np.array(self._padded), R=None, P=None, criteria=stop)
            rays = np.asarray(found, np.float64).reshape(self.height, self.width, 2)
            points = np.concatenate([rays, np.ones_like(rays[..., :1])], axis=-1)
            again = _project(self._vector(np.inf), points.reshape(-1, 3)).reshape(rays.shape)
            with np.errstate(invalid='ignore'):
                error = np.abs(again - np.stack([u, v], axis=-1)).max(axis=-1)
                steep = np.abs(rays).max(axis=-1) > _MAX_SLOPE
                rays[~(error < _MAX_ROUND_TRIP) | steep] = np.nan
        rays.flags.writeable = False
        return rays

    @cached_property
    def has_blind_pixels(self) -> bool:
        """Return whether some pixels have no ray."""
        return bool(np.isnan(self.rays).any())

    @cached_property
    def parameters(self) -> NDArray[np.float64]:
        """Return what the kernels' project_jet needs, (14,) float64."""
        reach = np.inf
        if any(self.distortion):
            # polynomials fold back outside the image: no point out there is seen
            reach = 1.1 * float(np.nanmax(np.sum(self.rays ** 2, axis=-1)))
        return self._vector(reach)

    def project(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """
        Project points of the camera frame.

        :param points: (n, 3) float64, metres
        :return: (n, 2) float64, pixels u, v; NaN behind the camera or outside the model's reach
        """
        return _project(self.parameters, np.ascontiguousarray(points, np.float64))

    @property
    def _padded(self) -> tuple[float, ...]:
        return (tuple(self.distortion) + (0.0,) * 8)[:8]

    def _vector(self, reach: float) -> NDArray[np.float64]:
        if not any(self.distortion):
            kind = _PINHOLE
        else:
            kind = _EQUIDISTANT if self.model == 'equidistant' else _RADIAL
        return np.array([kind, self.fx, self.fy, self.cx, self.cy, reach, *self._padded])


@njit(cache=True, nogil=True, error_model='numpy')
def project_jet(
    camera: NDArray[np.float64],
    x: float, x1: float, y: float, y1: float, z: float, z1: float,
) -> tuple[bool, float, float, float, float, float, float]:
    """
    Project a point that moves on a line of the camera frame, with two derivatives.

    :param camera: Camera.parameters
    :param x: the point, metres, and x1 its constant velocity; likewise y, z
    :return: whether it is seen, then u, u', u'', v, v', v'' (pixels)
    """
    if not z > 1e-9:
        return False, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    iz = 1.0 / z
    a = x * iz
    b = y * iz
    a1 = (x1 - a * z1) * iz
    b1 = (y1 - b * z1) * iz
    a2 = -2.0 * a1 * z1 * iz
    b2 = -2.0 * b1 * z1 * iz
    if camera[0] != _PINHOLE:
        t = a * a + b * b
        if t > camera[5]:
            return False, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        t1 = 2.0 * (a * a1 + b * b1)
        t2 = 2.0 * (a1 * a1 + a * a2 + b1 * b1 + b * b2)
        k1, k2, k3, k4 = camera[6], camera[7], camera[8], camera[9]
        p1, p2 = 0.0, 0.0
        if camera[0] == _RADIAL:
            k1, k2, p1, p2, k3 = camera[6], camera[7], camera[8], camera[9], camera[10]
            k4, k5, k6 = camera[11], camera[12], camera[13]
            n0 = 1.0 + t * (k1 + t * (k2 + t * k3))
            n1 = k1 + t * (2.0 * k2 + t * 3.0 * k3)
            n2 = 2.0 * k2 + t * 6.0 * k3
            d0 = 1.0 + t * (k4 + t * (k5 + t * k6))
            d1 = k4 + t * (2.0 * k5 + t * 3.0 * k6)
            d2 = 2.0 * k5 + t * 6.0 * k6
            s = n0 / d0
            st = (n1 - s * d1) / d0
            stt = (n2 - 2.0 * st * d1 - s * d2) / d0
        elif t < 1e-5:
            # series of theta_d / r about the axis
            s = 1.0 + t * (k1 - 1.0 / 3.0 + t * (0.2 - k1 + k2))
            st = k1 - 1.0 / 3.0 + 2.0 * t * (0.2 - k1 + k2)
            stt = 2.0 * (0.2 - k1 + k2)
        else:
            r = sqrt(t)
            o = atan(r)
            q = o * o
            w0 = o * (1.0 + q * (k1 + q * (k2 + q * (k3 + q * k4))))
            w1 = 1.0 + q * (3.0 * k1 + q * (5.0 * k2 + q * (7.0 * k3 + q * 9.0 * k4)))
            w2 = o * (6.0 * k1 + q * (20.0 * k2 + q * (42.0 * k3 + q * 72.0 * k4)))
            m = t * (1.0 + t)
            s = w0 / r
            st = 0.5 * (w1 / m - s / t)
            stt = 0.5 * (
                w2 / (2.0 * r * (1.0 + t) * m) - w1 * (1.0 + 2.0 * t) / (m * m)
                - st / t + s / (t * t))
        s1 = st * t1
        s2 = stt * t1 * t1 + st * t2
        c = a * b
        c1 = a1 * b + a * b1
        c2 = a2 * b + 2.0 * a1 * b1 + a * b2
        e = a * a
        e1 = 2.0 * a * a1
        e2 = 2.0 * (a1 * a1 + a * a2)
        g = b * b
        g1 = 2.0 * b * b1
        g2 = 2.0 * (b1 * b1 + b * b2)
        xd = a * s + 2.0 * p1 * c + p2 * (t + 2.0 * e)
        xd1 = a1 * s + a * s1 + 2.0 * p1 * c1 + p2 * (t1 + 2.0 * e1)
        xd2 = a2 * s + 2.0 * a1 * s1 + a * s2 + 2.0 * p1 * c2 + p2 * (t2 + 2.0 * e2)
        yd = b * s + 2.0 * p2 * c + p1 * (t + 2.0 * g)
        yd1 = b1 * s + b * s1 + 2.0 * p2 * c1 + p1 * (t1 + 2.0 * g1)
        yd2 = b2 * s + 2.0 * b1 * s1 + b * s2 + 2.0 * p2 * c2 + p1 * (t2 + 2.0 * g2)
        a, a1, a2, b, b1, b2 = xd, xd1, xd2, yd, yd1, yd2
    fx, fy = camera[1], camera[2]
    return True, fx * a + camera[3], fx * a1, fx * a2, fy * b + camera[4], fy * b1, fy * b2


@njit(cache=True, nogil=True)
def _project(
    camera: NDArray[np.float64], points: NDArray[np.float64]
) -> NDArray[np.float64]:
    pixels = np.full((len(points), 2), np.nan)
    for i in range(len(points)):
        x, y, z = points[i]
        seen, u, _, _, v, _, _ = project_jet(camera, x, 0.0, y, 0.0, z, 0.0)
        if seen:
            pixels[i, 0] = u
            pixels[i, 1] = v
    return pixels
