"""A camera: rays through its lens, and what sensor and development make of the light."""

from __future__ import annotations

import io
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from .. import _core
from ..model import ControlPoint, FloatArray, View
from .scene import Scene

Photo = npt.NDArray[np.uint8]

_BAND = 256


@dataclass(frozen=True)
class Response:
    """How a camera turns radiance into pixels: blur of the lens (Gaussian sigma, px), exposure (``None``: automatic),
    white balance, fall-off towards the corners, a shoulder for the lights, sRGB coding, noise, JPEG."""

    blur: float = 0.45
    exposure: float | None = None
    white: tuple[float, float, float] = (1.0, 1.0, 1.0)
    vignetting: float = 0.12
    read_noise: float = 0.0012
    shot_noise: float = 0.004
    jpeg_quality: int | None = 94

    def without_noise(self) -> Response:
        """The same camera with neither pixel noise nor compression."""
        return replace(self, read_noise=0.0, shot_noise=0.0, jpeg_quality=None)

    def exposed(self, radiance: npt.NDArray[np.float32]) -> Response:
        """This response with its exposure set by the picture: the brightest parts but a few keep their drawing."""
        if self.exposure is not None:
            return self
        grey = radiance[::4, ::4].mean(axis=-1)
        grey = grey[grey > 0]
        if len(grey) == 0:
            return replace(self, exposure=1.0)
        median, bright = np.percentile(grey, [50, 93])
        return replace(self, exposure=float(min(0.24 / max(median, 1e-4), 1.0 / max(bright, 1e-4))))

    def fall_off(self, xy: FloatArray, width: int, height: int) -> FloatArray:
        """The part of the light that reaches pixels (..., 2) away from the middle."""
        d = (xy - [(width - 1) / 2, (height - 1) / 2]) / (0.5 * np.hypot(width, height))
        return np.asarray(1.0 - self.vignetting * (d**2).sum(axis=-1))

    def coded(self, light: npt.NDArray[np.floating[Any]]) -> FloatArray:
        """Exposed linear light to values in [0, 255], not rounded."""
        x = np.maximum(light, 0.0)
        # Linear up to 0.6, then a shoulder that reaches 1 only in the limit.
        x = np.where(x > 0.6, 0.6 + 0.4 * (1.0 - np.exp(-(x - 0.6) / 0.4)), x)
        code = np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 1e-9) ** (1 / 2.4) - 0.055)
        return np.asarray(code * 255.0)


@dataclass(frozen=True)
class SimulatedPhoto:
    """A photo with its true view, the approximate one that one starts from, and its control points.

    ``points`` carry their measured coordinates, ``true_points`` the true ones, in the same order; ``blunders`` names
    those that were spoiled on purpose.
    """

    name: str
    image: Photo
    view: View
    start: View
    scene: Scene = field(repr=False)
    response: Response
    points: tuple[ControlPoint, ...] = ()
    true_points: tuple[ControlPoint, ...] = ()
    blunders: tuple[str, ...] = ()

    def visible(self, points: npt.ArrayLike, tolerance: float = 1e-5) -> npt.NDArray[np.bool_]:
        """Whether the photo shows each true surface point (N, 3), world frame."""
        return self.scene.visible(self.view, points, tolerance)

    def true_colour(self, points: npt.ArrayLike, *, own_surface: bool = True) -> FloatArray:
        """The colour (N, 3), 0 to 255 and not rounded, that this camera without noise shows at surface points (N, 3).

        With ``own_surface`` nothing that lies before or behind the surface within the lens's blur is mixed in. What is
        hidden gets the colour of what hides it: ask :meth:`visible`. NaN outside the lens's field.
        """
        xy, _ = _core.project(self.view.core, np.ascontiguousarray(points, dtype=np.float64))
        out = np.full((len(xy), 3), np.nan)
        width, height = self.view.core.width, self.view.core.height
        with np.errstate(invalid="ignore"):
            inside = (xy >= -0.5).all(axis=1) & (xy[:, 0] < width - 0.5) & (xy[:, 1] < height - 0.5)
        places = np.ascontiguousarray(xy[inside])
        light = self.scene.core.radiance_at(self.scene.in_scene(self.view), places, self.response.blur, own_surface)
        gain = (self.response.exposure or 1.0) * self.response.fall_off(places, width, height)
        out[inside] = self.response.coded(light * gain[:, None] * np.asarray(self.response.white))
        return out

    @cached_property
    def depth_image(self) -> tuple[FloatArray, npt.NDArray[np.int32]]:
        """Distance and primitive at every pixel's centre; see :meth:`Scene.depth_image`."""
        return self.scene.depth_image(self.view)


def radiance(scene: Scene, view: View, samples: int = 16) -> npt.NDArray[np.float32]:
    """Linear radiance (H, W, 3) of every pixel, averaged over its area, before lens blur and sensor.

    Pixels with edges get ``samples`` rays (a power of two), even ones four.
    """
    local = scene.in_scene(view)
    height = view.core.height
    # In bands, so that Ctrl-C is heard between them.
    bands = [scene.core.picture(local, row, min(row + _BAND, height), samples) for row in range(0, height, _BAND)]
    return np.concatenate(bands)


def develop(light: npt.NDArray[np.float32], response: Response, rng: np.random.Generator) -> tuple[Photo, Response]:
    """The photo that sensor and development make of a radiance image, and the response with its exposure."""
    response = response.exposed(light)
    height, width = light.shape[:2]
    image = blurred(light, response.blur)
    x = np.arange(width, dtype=np.float64)
    rows = np.empty((height, width, 3), np.uint8)
    for first in range(0, height, _BAND):
        band = image[first : first + _BAND]
        y = np.arange(first, first + len(band), dtype=np.float64)
        xy = np.stack(np.meshgrid(x, y), axis=-1)
        gain = (response.exposure or 1.0) * response.fall_off(xy, width, height)
        exposed = (band * gain[..., None].astype(np.float32)) * np.asarray(response.white, dtype=np.float32)
        if response.read_noise > 0 or response.shot_noise > 0:
            variance = response.read_noise**2 + response.shot_noise**2 * np.maximum(exposed, 0.0)
            noise = np.sqrt(variance) * rng.standard_normal(exposed.shape, dtype=np.float32)
            exposed = (exposed + noise).astype(np.float32)
        rows[first : first + len(band)] = np.clip(response.coded(exposed) + 0.5, 0, 255).astype(np.uint8)
    if response.jpeg_quality is not None:
        rows = _compressed(rows, response.jpeg_quality)
    return rows, response


def blurred(image: npt.NDArray[np.float32], sigma: float) -> npt.NDArray[np.float32]:
    """A Gaussian blur of ``sigma`` pixels; the border repeats its edge."""
    if sigma <= 0:
        return image
    radius = int(np.ceil(4.0 * sigma)) + 2
    # The discrete Gaussian (Lindeberg 1990): its variance is sigma² however small that is, unlike a sampled one's.
    frequency = 2.0 * np.pi * np.fft.rfftfreq(64 * radius)
    kernel = np.fft.fftshift(np.fft.irfft(np.exp(sigma**2 * (np.cos(frequency) - 1.0))))
    kernel = kernel[31 * radius : 33 * radius + 1].astype(np.float32)
    kernel /= kernel.sum()
    for axis in (0, 1):
        padding = [(radius, radius) if a == axis else (0, 0) for a in range(3)]
        padded = np.pad(image, padding, mode="edge")
        length = image.shape[axis]
        out = np.zeros_like(image)
        for k, weight in enumerate(kernel):
            out += weight * (padded[k : k + length] if axis == 0 else padded[:, k : k + length])
        image = out
    return image


def _compressed(image: Photo, quality: int) -> Photo:
    """What is left of an image after JPEG."""
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, "JPEG", quality=quality, subsampling=0)
    return np.asarray(Image.open(buffer).convert("RGB"))
