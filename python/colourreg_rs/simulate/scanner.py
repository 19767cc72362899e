"""A terrestrial laser scanner: a grid of directions, ranges with noise, intensity in near infrared.

Received power follows the laser-range equation for surfaces larger than the beam: ``P = ρ cos θ (r₀ / r)²`` with ρ the
near-infrared reflectance averaged over the beam's footprint, θ the incidence angle, r the range, and r₀ the range at
which a white surface seen square on just fills the detector. Intensity is ``65535 · min(P, 1)`` as uint16; below the
detector's threshold nothing returns.

Range noise: ``σ_r² = constant² + (share · r)² + (slant · w tan θ)² + (weak / √P)²``: of the timer, the clock, the beam
of width w on a slanted surface, and the weak signal.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from ..model import FloatArray, PointCloud
from .scene import Scene

BoolArray = npt.NDArray[np.bool_]
IntArray = npt.NDArray[np.int32]


@dataclass(frozen=True)
class Scanner:
    """An instrument. Angles in radians, lengths in metres; elevation from the horizon upwards.

    ``mixed``: what becomes of returns whose beam meets two surfaces at different ranges: ``"none"`` (the middle ray
    alone counts, as if there were none), ``"keep"`` (their range lies anywhere between) or ``"remove"``.
    """

    step: float = 0.0012
    azimuth: tuple[float, float] = (-np.pi, np.pi)
    elevation: tuple[float, float] = (-0.95, 1.2)
    range_constant: float = 0.001
    range_share: float = 10e-6
    range_slant: float = 0.08
    range_weak: float = 20e-6
    angle_sigma: float = 15e-6
    beam_width: float = 0.0035
    divergence: float = 0.25e-3
    reference_range: float = 6.0
    intensity_noise: float = 0.02
    threshold: float = 15.0
    limits: tuple[float, float] = (0.5, 150.0)
    mixed: Literal["none", "keep", "remove"] = "none"

    def without_noise(self) -> Scanner:
        """The same instrument with perfect ranges, angles and intensities."""
        return Scanner(
            self.step, self.azimuth, self.elevation, 0.0, 0.0, 0.0, 0.0, 0.0, self.beam_width, self.divergence,
            self.reference_range, 0.0, self.threshold, self.limits, "none",
        )  # fmt: skip


@dataclass(frozen=True)
class ScanTruth:
    """What is true of each point of a scan (world frame): where the middle ray met the surface, on which primitive and
    object, the normal towards the scanner, the linear reflectance (red, green, blue, near infrared), the range's
    sigma, the station, and whether the beam met two surfaces."""

    surface: FloatArray
    primitive: IntArray
    object: IntArray
    normal: FloatArray
    reflectance: npt.NDArray[np.float32]
    range_sigma: FloatArray
    station: IntArray
    mixed: BoolArray

    def __len__(self) -> int:
        return len(self.surface)


def scan(
    scene: Scene, stations: list[FloatArray], scanner: Scanner, rng: np.random.Generator
) -> tuple[PointCloud, ScanTruth]:
    """The merged scan from stations (world positions of the scanner's centre), with its truth."""
    parts = [_scan_station(scene, station, i, scanner, rng) for i, station in enumerate(stations)]
    xyz = np.concatenate([p[0] for p in parts])
    intensity = np.concatenate([p[1] for p in parts])
    fields = [np.concatenate([getattr(p[2], name) for p in parts]) for name in ScanTruth.__dataclass_fields__]
    return PointCloud(xyz, intensity=intensity), ScanTruth(*fields)


def _directions(scanner: Scanner, rng: np.random.Generator) -> FloatArray:
    """The grid as the instrument turns it: columns of constant azimuth, with each direction's own error."""
    azimuth = np.arange(*scanner.azimuth, scanner.step)
    elevation = np.arange(*scanner.elevation, scanner.step)
    a, e = (g.ravel() for g in np.meshgrid(azimuth, elevation, indexing="ij"))
    if scanner.angle_sigma > 0:
        # The pointing error is what the scan is told wrongly; the beam itself goes where it goes.
        a = a + rng.normal(0.0, scanner.angle_sigma, a.shape) / np.maximum(np.cos(e), 0.05)
        e = e + rng.normal(0.0, scanner.angle_sigma, e.shape)
    return _unit(a, e)


def _unit(azimuth: FloatArray, elevation: FloatArray) -> FloatArray:
    c = np.cos(elevation)
    return np.stack([c * np.cos(azimuth), c * np.sin(azimuth), np.sin(elevation)], axis=1)


def _scan_station(
    scene: Scene, station: FloatArray, number: int, scanner: Scanner, rng: np.random.Generator
) -> tuple[FloatArray, npt.NDArray[np.uint16], ScanTruth]:
    # The instrument's azimuth counts from the scene's own x axis, whatever frame the world has.
    told = _directions(Scanner(**{**scanner.__dict__, "angle_sigma": 0.0}), rng)
    true = _directions(scanner, rng) if scanner.angle_sigma > 0 else told
    told, true = told @ scene.frame.rotation.T, true @ scene.frame.rotation.T
    hits = scene.cast(station, true)
    keep = np.isfinite(hits.distance) & (hits.distance > scanner.limits[0]) & (hits.distance < scanner.limits[1])
    told, true = told[keep], true[keep]
    distance, primitive, normal = hits.distance[keep], hits.primitive[keep], hits.normal[keep]
    surface = station + true * distance[:, None]
    width = scanner.beam_width + scanner.divergence * distance
    cosine = np.clip(-(normal * true).sum(axis=1), 1e-3, 1.0)
    reflectance = scene.reflectance(surface, primitive, width / np.sqrt(cosine)).astype(np.float32)
    power = reflectance[:, 3] * cosine * (scanner.reference_range / distance) ** 2
    # Glass lets the beam through; what little comes back does so square on.
    power = np.where(scene.glass[primitive], power * 0.1 * cosine**8, power)
    measured = power * (1.0 + scanner.intensity_noise * rng.standard_normal(len(power)))
    counts = 65535.0 * np.clip(measured, 0.0, 1.0)

    tangent = np.sqrt(np.clip(1.0 / cosine**2 - 1.0, 0.0, 400.0))
    sigma = np.sqrt(
        scanner.range_constant**2
        + (scanner.range_share * distance) ** 2
        + (scanner.range_slant * width * np.minimum(tangent, 10.0)) ** 2
        + scanner.range_weak**2 / np.maximum(power, 1e-4)
    )
    ranges = distance + sigma * rng.standard_normal(len(distance))
    mixed = np.zeros(len(distance), dtype=np.bool_)
    keep = counts >= scanner.threshold
    if scanner.mixed != "none":
        mixed, blended = _mixed(scene, station, true, distance, width, rng)
        if scanner.mixed == "keep":
            ranges = np.where(mixed, ranges + blended - distance, ranges)
        else:
            keep &= ~mixed
    truth = ScanTruth(
        surface[keep],
        primitive[keep],
        scene.object_of_primitive[primitive[keep]],
        normal[keep],
        reflectance[keep],
        sigma[keep],
        np.full(int(keep.sum()), number, np.int32),
        mixed[keep],
    )
    xyz = station + told[keep] * ranges[keep, None]
    return xyz, np.round(counts[keep]).astype(np.uint16), truth


def _mixed(
    scene: Scene,
    station: FloatArray,
    rays: FloatArray,
    distance: FloatArray,
    width: FloatArray,
    rng: np.random.Generator,
) -> tuple[BoolArray, FloatArray]:
    """Which beams meet two surfaces, and the range that mixes them, by four rays on the beam's rim."""
    helper = np.where(np.abs(rays[:, 2:3]) > 0.9, [[1.0, 0.0, 0.0]], [[0.0, 0.0, 1.0]])
    across = np.cross(rays, helper)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    upward = np.cross(across, rays)
    radius = (0.5 * width / distance)[:, None]
    rim = [scene.cast(station, rays + radius * d).distance for d in (across, -across, upward, -upward)]
    ranges = np.where(np.isfinite(rim), rim, distance)
    spread = ranges.max(axis=0) - ranges.min(axis=0)
    # A step, not a slope: an edge shows as a range far beyond what the others' trend explains.
    slope = np.abs(ranges[0] + ranges[1] - 2 * distance) + np.abs(ranges[2] + ranges[3] - 2 * distance)
    mixed = (slope > 0.02) & (spread > 0.03)
    weights = rng.dirichlet(np.ones(5), len(distance))
    blended = weights[:, 0] * distance + (weights[:, 1:].T * ranges).sum(axis=0)
    return mixed, np.where(mixed, blended, distance)
