"""From an approximate view to a registration, without picking: the loop of SCI, matching and resection.

The SCI is rendered at the current view and matched with the photo; resection gives the next view; and the SCI is
rendered again, until the view stands still. Coarse to fine: at the coarsest level templates span many degrees, are
searched over the whole of the start's uncertainty, each for itself, and a robust resection takes those that agree; from
there on all templates are taken together (:mod:`.surfaces`). At the finest level the last word is the points' own, at
their own places (:mod:`.pointwise`). The single pass of Forkuo and King is the first turn alone, at the finest level.

A result is believed only if the patches of the photo, each searched far beyond its own noise, come back to where they
were (``confirmed``); one that is not is returned as a failure, with the figures that say so.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from .. import _core
from ..errors import DegenerateError, InvalidInputError, NotConvergedError
from ..model import Covariance, FloatArray, PointCloud, Pose, View
from ..sci import SCI
from .afar import agreeing_rotations
from .correspondences import (
    Correspondences,
    PhotoPyramid,
    Search,
    find_correspondences,
    pixels_per_radian,
    supported_scale,
)
from .match_covariance import match_covariance, patch_covariance
from .parameters import design, stepped, value_of
from .pointwise import LOOKS, READ, STEPS, STRIDE, Look, Patches, PointwisePhoto
from .surfaces import Linearised, Surfaces, find_surfaces, joined

#: The finest level has this many pixels per spacing of the points: matches err by a share of the level's pixel,
#: whatever the spacing, since points count at their own places in the pixels.
OVERSAMPLING = 3.0

#: The coarsest level has about this many pixels along the long side.
COARSEST = 300

#: So many different rotations that matches agree on are followed from the start.
ROTATIONS = 2

#: So many renderings of a level are taken together.
TOGETHER = 4

#: Single templates whose likeness is less than this are no match.
LIKE = 0.2

#: The photo is confirmed in so many patches along its long and its short side.
PATCHES = (6, 4)

#: So many of them have to come back, as a share, and at least so many have to have something in them.
CONFIRMED, LEAST_PATCHES = 0.4, 4

#: A view whose predicted error, px per coordinate, is larger is no result.
WORST = 5.0


@dataclass(frozen=True)
class SciOptions:
    """How a view is registered to the SCI.

    - ``free``: what is estimated; camera parameters only at the finest level.
    - ``search``: how far off the start may be, radians, position and rotation together as seen in the photo.
    - ``shift``: how far off the start's projection centre may be, metres, one sigma; for the coarse levels only.
    - ``priors``: (name, value, sigma) of parameters known before, as in resection; they hold at every level.
    - ``tolerance``: the loop ends when the view moves less than this anywhere in the photo, px.
    - ``passes``: at most this many turns of templates at every level, and two at the finest.
    - ``single``: one turn at the finest level and nothing else: the single pass of the literature.
    - ``station``: (3,) where the scanner stood, for the correction of the intensity.
    """

    free: tuple[str, ...] = ("pose",)
    search: float = float(np.radians(6.0))
    shift: float = 0.5
    priors: tuple[tuple[str, float, float], ...] = ()
    tolerance: float = 0.1
    passes: int = 3
    single: bool = False
    station: tuple[float, float, float] | None = None


@dataclass(frozen=True)
class Turn:
    """One turn of the loop: at ``scale`` of the photo, ``templates`` (or patches of points) were compared, ``matched``
    are alike, and the view ``moved`` this far at most anywhere in the photo, px."""

    scale: float
    templates: int
    matched: int
    moved: float


@dataclass(frozen=True)
class SciRegistration:
    """What the loop came to.

    - ``view``: the new view with its covariance, or the start where the result is not to be believed.
    - ``trusted`` and ``reasons``: whether it is, and why not.
    - ``turns``: what happened.
    - ``confirmed``: of the photo's patches, each searched over a wide window at the result, the share that came back to
      within ``confirmed_within`` px of the photo; by chance it would be ``by_chance``.
    - ``matches``: the templates of the last turn, as seen from the view.
    - ``used``: how many of them are alike.
    - ``predicted_error``: rms over the photo of the position error that the covariance predicts, px per coordinate.
    - ``improvement``: mean likeness at the result less that at the start, and its standard error.
    """

    view: View
    trusted: bool
    reasons: tuple[str, ...]
    turns: tuple[Turn, ...]
    confirmed: float
    confirmed_within: float
    by_chance: float
    matches: Linearised | None
    used: int
    predicted_error: float
    improvement: tuple[float, float]
    statistics: dict[str, Any]


class _LoopError(Exception):
    """The loop cannot go on; the message says why."""


def register_sci(
    cloud: PointCloud | Iterable[PointCloud],
    photo: npt.NDArray[Any],
    view: View,
    options: SciOptions | None = None,
) -> SciRegistration:
    """Refines an approximate view of a photo (H, W) or (H, W, 3) against a cloud with intensity or colour.

    A start that is farther off than ``options.search`` is not found, and said so: then ``trusted`` is false and the
    view is the start. Raises InvalidInputError where photo, camera and cloud do not fit each other.
    """
    options = options or SciOptions()
    if view.camera is None or view.pose is None:
        raise InvalidInputError(
            f"view {view.name!r}: registration by SCI starts from a camera and a pose, not from a DLT"
        )
    if photo.ndim not in (2, 3) or photo.shape[:2] != (view.camera.height, view.camera.width):
        raise InvalidInputError(
            f"the photo of {photo.shape[1] if photo.ndim > 1 else 0} x {photo.shape[0]} pixels is not that of the "
            f"camera, {view.camera.width} x {view.camera.height}"
        )
    whole = cloud if isinstance(cloud, PointCloud) else _joined(cloud)
    return _Loop(whole, PhotoPyramid.of(photo), view, options).run()


def _joined(chunks: Iterable[PointCloud]) -> PointCloud:
    parts = list(chunks)
    if not parts:
        raise InvalidInputError("the cloud has no points")

    def column(name: str) -> Any:
        values = [getattr(p, name) for p in parts]
        return None if any(v is None for v in values) else np.concatenate(values)

    return PointCloud(column("xyz"), column("intensity"), column("rgb"), column("normals"))


class _Loop:
    def __init__(self, cloud: PointCloud, photo: PhotoPyramid, start: View, options: SciOptions) -> None:
        self.cloud, self.photo, self.start, self.options = cloud, photo, start, options
        self.turns: list[Turn] = []
        self.exponents: tuple[float, float] | None = None
        self.station = None if options.station is None else np.array(options.station, dtype=np.float64)
        camera = start.camera
        assert camera is not None
        self.long_side = max(camera.width, camera.height)
        # Where movement and predicted errors are looked at: points of the cloud all over the photo.
        self.witnesses = np.empty((0, 3))

    def run(self) -> SciRegistration:
        try:
            view = self._iterate()
        except _LoopError as failure:
            return self._failed(str(failure))
        except (DegenerateError, NotConvergedError) as error:
            return self._failed(str(error))
        return self._judged(view)

    # The turns -------------------------------------------------------------------------------------------------

    def _scales(self) -> list[float]:
        self.supported = supported_scale(self.cloud, self.start)
        if self.supported == 0.0:
            raise _LoopError("no point of the cloud lies in the photo at the start")
        self.finest = min(1.0, OVERSAMPLING * self.supported)
        scales = [self.finest]
        while not self.options.single and scales[0] * self.long_side > 1.5 * COARSEST:
            scales.insert(0, scales[0] / 2)
        return scales

    def _iterate(self) -> View:
        scales = self._scales()
        view = self._from_afar(self.start, scales[0])
        if self.options.single:
            self.last = self._surfaces(view, scales[0], 5)
            return view
        for level, scale in enumerate(scales):
            finest = level == len(scales) - 1
            renderings: list[Surfaces] = []
            for turn in range(min(self.options.passes, 2) if finest else self.options.passes):
                found = self._surfaces(view, scale, 8 if turn == 0 else 5, turn)
                # Every rendering has noise of its own: where points happen to lie in their pixels. Taken together, the
                # last few have less of it, and the view comes to rest.
                if turn > 0:
                    renderings = [*renderings[1 - TOGETHER :], found]
                new = self._climbed(view, joined(renderings) if renderings else found, finest)
                moved = self._moved(view, new)
                self.turns.append(Turn(scale, len(found), int((found.here > LIKE).sum()), moved))
                view, self.last = new, found
                if moved < 0.5 / scale:
                    break
        return self._settled(view)

    def _from_afar(self, view: View, scale: float) -> View:
        """The first turn: large templates, each searched over the whole of the start's uncertainty."""
        per_radian = pixels_per_radian(self.start) * scale
        radius = int(np.clip(np.ceil(self.options.search * per_radian), 4, 80))
        half = 12 if self.options.single else 24
        found = self._find(view, scale, Search(half=half, radius=radius, cell=8, per_cell=2, hypotheses=3))
        starts = [view]
        for new in agreeing_rotations(view, found, self.options.search, 1 if self.options.single else ROTATIONS):
            starts.append(new)
            for unit in (8.0, 3.0, 1.0):
                new = self._resect(new, found.xyz, found.xy, found.covariance * unit**2, "tukey", False)
            starts.append(new)
        new = starts[-1] if self.options.single else self._likeliest(starts, scale)
        self.turns.append(Turn(scale, found.templates, len(found), self._moved(view, new)))
        return new

    def _likeliest(self, starts: list[View], scale: float) -> View:
        """Of several starts the one from which the templates' likeness climbs highest.

        Near walls a rotation explains the matches badly and a resection is led astray by false ones; far away the
        resection is better. The pictures themselves tell which: at a wrong place hardly anything is alike.
        """
        best, most = starts[0], -np.inf
        seen, reached = list[View](), list[View]()
        for view in starts:
            # Rotations often lead a resection to one and the same view, and several starts to one summit.
            if any(self._moved(view, v) < 1.0 / scale for v in seen):
                continue
            seen.append(view)
            try:
                new = self._climbed(view, self._surfaces(view, scale, 8), False)
                if any(self._moved(new, v) < 1.0 / scale for v in reached):
                    continue
                reached.append(new)
                value = float(self._surfaces(new, scale, 2).log_likelihood()[:, 2, 2].sum())
            except (_LoopError, DegenerateError, NotConvergedError):
                continue
            if value > most:
                best, most = new, value
        return best

    def _surfaces(self, view: View, scale: float, radius: int, offset: int = 0) -> Surfaces:
        found, sci = find_surfaces(
            self.cloud, view, self.photo, scale, radius=radius, spacing=scale / self.supported, offset=offset,
            station=self.station, exponents=self.exponents,
        )  # fmt: skip
        self.exponents = sci.exponents
        if len(found) < 12:
            raise _LoopError(
                f"only {len(found)} templates of the cloud's picture lie in the photo at {scale:.3f} of its size; at "
                f"least 12 are needed"
            )
        return found

    def _climbed(self, view: View, found: Surfaces, final: bool) -> View:
        """The view at which the templates' likeness is largest in sum, from here upwards."""
        surfaces = found.log_likelihood()
        here = found.linearised(view, surfaces)
        for _ in range(8):
            if len(here.xyz) < 12:
                raise _LoopError(f"only {len(here.xyz)} templates lie within their windows; at least 12 are needed")
            new = self._resect(view, here.xyz, here.xy, here.covariance, "squares", final)
            there = found.linearised(new, surfaces)
            if there.value <= here.value:
                break
            moved = self._moved(view, new)
            view, here = new, there
            if moved < 0.2 * self.options.tolerance:
                break
        return view

    def _settled(self, view: View) -> View:
        """The view at which the photo explains most of the points' intensities, from here upwards."""
        scale = min(1.0, READ * self.supported)
        width, height = (max(round(n * scale), 16) for n in (view.core.width, view.core.height))
        photo = PointwisePhoto(self.photo.pixels, width, height)
        for _ in range(LOOKS):
            before, spacing = view, scale / self.supported
            look = Look.at(self.cloud, view, self.names, photo, spacing, self.station, self.exponents)
            for _ in range(STEPS):
                found = look.patches(view)
                new = stepped(view, self.names, STRIDE * self._step(view, found))
                moved, view = self._moved(view, new), new
                if moved < 0.2 * self.options.tolerance:
                    break
            self.patches = look.patches(view)
            alike = int((self.patches.explained > LIKE).sum())
            self.turns.append(Turn(scale, len(self.patches.value), alike, self._moved(before, view)))
            if self.turns[-1].moved < self.options.tolerance:
                break
        return view

    def _step(self, view: View, patches: Patches) -> FloatArray:
        """The Gauss-Newton step of the patches and of what is known before."""
        information, gradient = patches.information.sum(0), patches.gradient.sum(0)
        for name, value, sigma in self.options.priors:
            if name in self.names and sigma > 0:
                k = self.names.index(name)
                information[k, k] += sigma**-2
                gradient[k] += (value - value_of(view, name)) / sigma**2
        size = np.sqrt(np.diagonal(information))
        if not (np.isfinite(size).all() and (size > 0).all()):
            raise _LoopError("the photo explains nothing of the points' intensities")
        scaled = information / np.outer(size, size)
        if np.linalg.eigvalsh(scaled)[0] < 1e-12:
            raise _LoopError("the points' intensities do not determine the view")
        return np.asarray(np.linalg.solve(scaled, gradient / size) / size)

    def _find(self, view: View, scale: float, search: Search) -> Correspondences:
        found, sci = find_correspondences(
            self.cloud, view, self.photo, scale, search, station=self.station, exponents=self.exponents
        )
        self.exponents = sci.exponents
        if len(self.witnesses) == 0:
            self.witnesses = self._spread_points(sci)
        if len(found) < 12:
            counts = ", ".join(f"{n} {name}" for name, n in found.outcomes.items() if n)
            raise _LoopError(
                f"only {len(found)} of {found.templates} templates were found in the photo at "
                f"{scale:.3f} of its size ({counts or 'no interest points'}); at least 12 are needed"
            )
        return found

    def _spread_points(self, sci: SCI) -> FloatArray:
        rows, columns = np.nonzero(sci.measured)
        if len(rows) == 0:
            raise _LoopError("no point of the cloud lies in the photo at the start")
        step = max(len(rows) // 2000, 1)
        return np.ascontiguousarray(self.cloud.xyz[sci.index[rows[::step], columns[::step]]])

    def _resect(
        self, view: View, xyz: FloatArray, xy: FloatArray, covariance: FloatArray, loss: str, final: bool
    ) -> View:
        free = list(self.options.free) if final else ["pose"]
        priors = list(self.options.priors)
        held = {name for name, _, _ in priors}
        if not final:
            centre = self.start.core.centre
            for k, name in enumerate(("cx_world", "cy_world", "cz_world")):
                if name not in held:
                    priors.append((name, float(centre[k]), self.options.shift))
        result = _core.resect(
            view.core, xyz, xy, free=free, sigma_xy=covariance, priors=priors, loss=loss, start="given"
        )  # fmt: skip
        self.names = result.parameters
        camera, core = view.camera, result.view
        assert camera is not None
        params = dict(zip(camera.params, core.params.tolist(), strict=True))
        return replace(view, camera=replace(camera, params=params), pose=Pose(core.rotation, core.translation))

    def _moved(self, before: View, after: View) -> float:
        a, _ = _core.project(before.core, self.witnesses)
        b, _ = _core.project(after.core, self.witnesses)
        distance = np.linalg.norm(a - b, axis=1)
        distance = distance[np.isfinite(distance)]
        return float(distance.max()) if len(distance) else float("inf")

    # The verdict -----------------------------------------------------------------------------------------------

    def _judged(self, view: View) -> SciRegistration:
        found, last, reasons = self.last, self.turns[-1], list[str]()
        used = int((found.here > LIKE).sum())
        if used < 20:
            reasons.append(f"only {used} templates are alike at the view; 20 are needed")
        matches = found.linearised(view)
        if self.options.single:
            covariance = match_covariance(view, self.names, matches.xyz, matches.xy, matches.covariance, found.pixel)
        else:
            covariance = patch_covariance(view, self.patches, self.witnesses, found.pixel)
        predicted = float("nan")
        if covariance is None:
            reasons.append("the matches do not determine the view")
        else:
            predicted = self._predicted_error(view, covariance)
            view = replace(view, covariance=covariance)
            if predicted > WORST:
                reasons.append(
                    f"the predicted error over the photo is {predicted:.1f} px; at most {WORST:.0f} px is believed"
                )
        # A view that moves by less than its own error stands still.
        still = max(self.options.tolerance, predicted) if np.isfinite(predicted) else self.options.tolerance
        if not self.options.single and last.moved >= still:
            reasons.append(
                f"the view still moves by {last.moved:.2f} px after {len(self.turns)} turns, more than {still:.2f} px"
            )
        confirmed, within, by_chance, patches, found_here = self._confirmed(view)
        needed = max(CONFIRMED, 5 * by_chance)
        if patches < LEAST_PATCHES:
            reasons.append(
                f"only {patches} of the photo's {PATCHES[0] * PATCHES[1]} patches show enough of the cloud to be "
                f"searched; at least {LEAST_PATCHES} are needed"
            )
        elif confirmed < needed:
            reasons.append(
                f"of {patches} patches of the photo searched over a wide window {100 * confirmed:.0f} % come back to "
                f"within {within:.1f} px of their place; {100 * needed:.0f} % are needed, and by chance it would be "
                f"{100 * by_chance:.0f} %"
            )
        improvement = self._improvement(found_here)
        if not np.isfinite(improvement[0]) and improvement[0] < 0:
            reasons.append("at the view no template of the cloud's picture lies in the photo; at the start some do")
        elif improvement[0] < -2 * improvement[1]:
            reasons.append(
                f"the start fits better: its templates are alike by {-improvement[0]:.4f} ± {improvement[1]:.4f} more "
                f"on average"
            )
        statistics = {
            "matches": len(found), "used": used, "turns": len(self.turns), "confirmed": confirmed,
            "confirmed_by_chance": by_chance, "predicted_error_px": predicted, "last_move_px": last.moved,
            "improvement": improvement[0], "point_spacing_px": 1.0 / self.supported,
        }  # fmt: skip
        trusted = not reasons
        result = replace(view, method="sci", statistics=statistics) if trusted else self.start
        return SciRegistration(
            result, trusted, tuple(reasons), tuple(self.turns), confirmed, within, by_chance, matches, used,
            predicted, improvement, statistics,
        )  # fmt: skip

    def _failed(self, reason: str) -> SciRegistration:
        nan = float("nan")
        return SciRegistration(
            self.start, False, (reason,), tuple(self.turns), 0.0, nan, nan, None, 0, nan, (nan, nan), {}
        )

    def _predicted_error(self, view: View, covariance: Covariance) -> float:
        """Rms over the photo of the predicted position error, px per coordinate."""
        rows = design(view, covariance.parameters, self.witnesses)
        rows = rows[np.isfinite(rows).all((1, 2))]
        variances = np.einsum("nij,jk,nik->ni", rows, covariance.matrix, rows)
        return float(np.sqrt(variances.mean())) if len(rows) else float("nan")

    def _one_up(self) -> float:
        """The scale of the level above the finest, or the finest where it is the coarsest."""
        scale = self.finest
        return scale * (0.5 if scale * self.long_side > COARSEST else 1.0)

    def _confirmed(self, view: View) -> tuple[float, float, float, int, FloatArray]:
        """Patches of the photo, searched a dozen pixels around one level up, each for itself: how many come back.

        Also returns the likeness of all templates without a shift.
        """
        scale = self._one_up()
        radius, within = 12, 1.5
        by_chance = float(np.pi * within**2 / (2 * radius + 1) ** 2)
        try:
            found = self._surfaces(view, scale, radius)
        except (DegenerateError, _LoopError):
            return 0.0, within / scale, by_chance, 0, np.empty(0)
        wide, high = PATCHES if found.size[0] >= found.size[1] else PATCHES[::-1]
        share = found.places * found.scale / found.size
        patch = (share[:, 1] * high).astype(int) * wide + (share[:, 0] * wide).astype(int)
        surfaces = found.log_likelihood()
        back = []
        for k in range(wide * high):
            mine = surfaces[patch == k]
            if len(mine) >= 4:
                row, column = np.divmod(int(np.argmax(mine.sum(0))), 2 * radius + 1)
                back.append(np.hypot(row - radius, column - radius) <= within)
        return float(np.mean(back)) if back else 0.0, within / scale, by_chance, len(back), found.here

    def _improvement(self, b: FloatArray) -> tuple[float, float]:
        """Mean of the result's likenesses ``b`` without a shift, one level up, less that of the start's, and its
        standard error."""
        try:
            a = self._surfaces(self.start, self._one_up(), 2).here
        except (DegenerateError, _LoopError):
            a = np.empty(0)
        if len(a) == 0 or len(b) == 0:
            return (float("inf") if len(b) > len(a) else float("-inf"), 0.0)
        return float(b.mean() - a.mean()), float(np.sqrt(a.var() / len(a) + b.var() / len(b)))
