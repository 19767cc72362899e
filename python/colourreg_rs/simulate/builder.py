"""Puts a scene together from rectangles, boxes, columns, spheres and leaves, each in the frame of its object."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from .. import _core
from .lighting import Lighting
from .materials import Layer, Material, Painting

FloatArray = npt.NDArray[np.float64]
Vector = Sequence[float] | FloatArray

PARALLELOGRAM, TRIANGLE, ELLIPSE, LEAF, FRUSTUM, SPHERE = range(6)


@dataclass
class Parts:
    """What a scene is made of, in the order in which it was put in."""

    rows: list[tuple[float, ...]] = field(default_factory=list)
    materials: list[Material] = field(default_factory=list)
    objects: list[str] = field(default_factory=list)
    object_of_primitive: list[int] = field(default_factory=list)
    marks: dict[str, FloatArray] = field(default_factory=dict)


class Builder:
    """Adds primitives in a local frame: x to the right, z up, and for façades y inwards, away from the street.

    ``place`` gives a builder in another frame that adds to the same scene.
    """

    def __init__(self, parts: Parts | None = None, origin: Vector = (0.0, 0.0, 0.0), axes: FloatArray | None = None):
        self.parts = parts if parts is not None else Parts()
        self.origin = np.asarray(origin, dtype=np.float64)
        self.axes = np.eye(3) if axes is None else axes
        self._object = 0

    def place(self, origin: Vector, yaw: float = 0.0) -> Builder:
        """A builder whose frame stands at ``origin`` (in this frame), turned by ``yaw`` about the vertical."""
        c, s = np.cos(yaw), np.sin(yaw)
        turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        inner = Builder(self.parts, self.point(origin), self.axes @ turn)
        inner._object = self._object
        return inner

    def named(self, name: str) -> Builder:
        """What is added from here on belongs to a new object of this name."""
        self.parts.objects.append(name)
        self._object = len(self.parts.objects) - 1
        return self

    def point(self, p: Vector) -> FloatArray:
        """A local point in the scene's frame."""
        return np.asarray(self.origin + self.axes @ np.asarray(p, dtype=np.float64))

    def mark(self, name: str, p: Vector) -> None:
        """Remembers a distinct point (a corner, a target's centre) by name."""
        self.parts.marks[name] = self.point(p)

    def _add(
        self, outline: int, origin: Vector, u: Vector, v: FloatArray, uv: Sequence[float], material: Material
    ) -> None:
        if not self.parts.objects:
            self.parts.objects.append("scene")
        o, u = self.point(origin), self.axes @ np.asarray(u, dtype=np.float64)
        self.parts.rows.append((outline, *o, *u, *v, *uv))
        self.parts.materials.append(material)
        self.parts.object_of_primitive.append(self._object)

    def flat(
        self, outline: int, origin: Vector, u: Vector, v: Vector, material: Material, uv: Sequence[float] = (0.0, 0.0)
    ) -> None:
        """A flat patch; its front is where u × v points."""
        self._add(outline, origin, u, self.axes @ np.asarray(v, dtype=np.float64), uv, material)

    def rectangle(
        self, origin: Vector, u: Vector, v: Vector, material: Material, uv: Sequence[float] = (0.0, 0.0)
    ) -> None:
        """A parallelogram with a corner at ``origin``; its front is where u × v points."""
        self.flat(PARALLELOGRAM, origin, u, v, material, uv)

    def triangle(self, a: Vector, b: Vector, c: Vector, material: Material) -> None:
        """A triangle, anticlockwise as seen from its front."""
        p, q, r = (np.asarray(x, dtype=np.float64) for x in (a, b, c))
        self.flat(TRIANGLE, p, q - p, r - p, material)

    def box(self, low: Vector, high: Vector, material: Material, *, open_faces: Iterable[str] = ()) -> None:
        """A box along the local axes. Surface coordinates run on around it, so that courses meet at the edges.

        ``open_faces`` leaves out any of ``-x +x -y +y -z +z``: what nobody sees, or what another box covers.
        """
        lo, hi = np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)
        dx, dy, _ = hi - lo
        left_out = set(open_faces)
        x, y, z = np.eye(3) * (hi - lo)[:, None]
        faces = {
            "-y": (lo, x, z, (lo[0], lo[2])),
            "+x": (lo + x, y, z, (lo[0] + dx, lo[2])),
            "+y": (lo + x + y, -x, z, (lo[0] + dx + dy, lo[2])),
            "-x": (lo + y, -y, z, (lo[0] - dy, lo[2])),
            "+z": (lo + z, x, y, (lo[0], hi[2])),
            "-z": (lo + y, x, -y, (lo[0], lo[2] - dy)),
        }
        for name, (origin, u, v, uv) in faces.items():
            if name not in left_out:
                self.rectangle(origin, u, v, material, uv)

    def column(
        self, foot: Vector, axis: Vector, radius: float, material: Material, *, top_radius: float | None = None
    ) -> None:
        """The mantle of a cylinder or of a cone frustum."""
        radii = np.array([radius, radius if top_radius is None else top_radius, 0.0])
        self._add(FRUSTUM, foot, axis, radii, (0.0, 0.0), material)

    def disc(self, centre: Vector, normal: Vector, radius: float, material: Material) -> None:
        """A disc; its front is where the normal points, its second surface coordinate is as near upwards as can be."""
        n = np.asarray(normal, dtype=np.float64)
        n = n / np.linalg.norm(n)
        helper = np.array([0.0, 1.0, 0.0]) if abs(n[2]) > 0.9 else np.array([0.0, 0.0, 1.0])
        u = np.cross(helper, n)
        u /= np.linalg.norm(u)
        self.flat(ELLIPSE, centre, u * radius, np.cross(n, u) * radius, material)

    def ball(self, centre: Vector, radius: float, material: Material) -> None:
        """A sphere."""
        self._add(SPHERE, centre, (1.0, 0.0, 0.0), np.array([radius, 0.0, 0.0]), (0.0, 0.0), material)

    def leaf(self, centre: Vector, along: Vector, across: Vector, material: Material) -> None:
        """A pointed leaf with these half axes."""
        self.flat(LEAF, centre, along, across, material)

    def wall(
        self,
        width: float,
        height: float,
        material: Material,
        openings: Sequence[tuple[float, float, float, float]] = (),
        *,
        low: float = 0.0,
    ) -> None:
        """A wall in the plane y = 0 that faces −y, with rectangular openings (left, low, right, high) left free."""
        levels = sorted({low, height, *(z for o in openings for z in (o[1], o[3]) if low < z < height)})
        for z0, z1 in pairwise(levels):
            holes = sorted((o[0], o[2]) for o in openings if o[1] <= z0 + 1e-9 and o[3] >= z1 - 1e-9)
            x = 0.0
            for x0, x1 in [*holes, (width, width)]:
                if x0 > x + 1e-9:
                    self.rectangle((x, 0, z0), (x0 - x, 0, 0), (0, 0, z1 - z0), material, (x, z0))
                x = max(x, x1)

    def build(self, lighting: Lighting) -> _core.SimulatedScene:
        """The compiled scene."""
        return compile_scene(self.parts, lighting)


def compile_scene(parts: Parts, lighting: Lighting) -> _core.SimulatedScene:
    """The tables that the core takes, from parts that share materials and paintings by identity."""
    materials: dict[int, int] = {}
    paintings: dict[int, int] = {}
    images: list[Painting] = []
    material_rows: list[tuple[float, ...]] = []
    layer_rows: list[tuple[float, ...]] = []
    indices = np.empty(len(parts.materials), np.int64)
    for i, material in enumerate(parts.materials):
        if id(material) not in materials:
            materials[id(material)] = len(material_rows)
            m = material
            material_rows.append((len(m.layers), m.gloss, m.translucency, *m.relief, *m.emission))
            for layer in m.layers:
                parameters = list(layer.parameters)
                if layer.painting is not None:
                    if id(layer.painting) not in paintings:
                        paintings[id(layer.painting)] = len(images)
                        images.append(np.ascontiguousarray(layer.painting))
                    parameters[0] = paintings[id(layer.painting)]
                layer_rows.append(_layer_row(layer, parameters))
        indices[i] = materials[id(material)]
    return _core.SimulatedScene(
        np.array(parts.rows, dtype=np.float64).reshape(-1, 12),
        indices,
        np.array(material_rows, dtype=np.float64).reshape(-1, 8),
        np.array(layer_rows, dtype=np.float64).reshape(-1, 16),
        images,
        lighting.row(),
    )


def _layer_row(layer: Layer, parameters: list[float]) -> tuple[float, ...]:
    padded = [*parameters, *[0.0] * (6 - len(parameters))]
    return (layer.pattern, *layer.colour, layer.amount, *layer.scale, layer.seed, *padded)
