"""What to do next, in plain words, from the figures of an assessment. The most harmful thing comes first."""

from __future__ import annotations

import numpy as np

from .assessment import CHECK_ALPHA, ViewAssessment

#: Angles that colours of scanners' own cameras are off by at worst, and those of third-party software: what the reader
#: may compare with. Over eight scanners, published by their users.
MAKERS_MRAD, THIRD_PARTY_MRAD = 2.0, 5.0
#: Below so many redundant coordinates no test says much.
FEW_FREEDOMS = 6
#: An expected error at the border that is so many times that of the middle says that the points lie in the middle.
UNEVEN = 2.5
#: A new point is worth its while where it takes off this share of the expected error.
WORTHWHILE = 0.1


def figure(value: float) -> str:
    """Two digits behind the point below one, one above: millimetres as people read them."""
    return f"{value:.2f}" if abs(value) < 1 else f"{value:.1f}"


def in_all_units(assessed: ViewAssessment, pixels: float) -> str:
    """``0.42 px = 1.3 mm = 0.14 mrad`` at the points' usual distance."""
    if not np.isfinite(assessed.depth):
        return f"{pixels:.2f} px = {assessed.milliradians(pixels):.2f} mrad"
    mm, mrad = assessed.millimetres(pixels), assessed.milliradians(pixels)
    return f"{pixels:.2f} px = {figure(mm)} mm at {assessed.depth:.1f} m = {mrad:.2f} mrad"


def advice(assessed: ViewAssessment) -> tuple[str, ...]:
    """Sentences that each say what to do and why, with the figure."""
    said = [*_of_disagreement(assessed), *_of_points(assessed), *_of_checks(assessed), *_of_the_next_point(assessed)]
    said += [
        f"{x.sentence()} Look at the overlay of the cloud's edges on the photo instead."
        for x in assessed.agreement
        if not x.tells
    ]
    if not said:
        said.append("Nothing needs to be done: no test fails, and one more control point would gain little.")
    return tuple(said)


def headline(assessed: ViewAssessment) -> tuple[str, str]:
    """The verdict in a word (``good``, ``look``, ``bad``) and in a sentence."""
    a = assessed.adjustment or {}
    worrying = [x for x in assessed.agreement if x.systematic and not x.explained]
    if worrying:
        return "bad", f"Cloud and photo lie apart: {worrying[0].sentence()}"
    p, off = _check_verdict(assessed)
    if p is not None and p < CHECK_ALPHA:
        return "bad", f"The check points differ from the view by more than its covariance allows (p = {p:.1g})."
    if off:
        several = len(off) > 1
        return "look", (
            f"Check point{'s' if several else ''} {', '.join(off)} contradict{'' if several else 's'} the view; the "
            "others agree with it."
        )
    test = a.get("variance_test")
    if test and not test["accepted"] and assessed.view.statistics.get("sigma0", 1.0) > 1:
        return "look", "The residuals are larger than the stated sigmas promise: see what to do next."
    if assessed.error_map is None:
        return "look", "How accurate this view is away from its points is not known: it has no covariance."
    figures = assessed.error_map.figures()
    colour = assessed.surface.figures() if assessed.surface else None
    if colour:
        mm, mrad = colour["mm"], colour["mrad"]
        return "good" if mrad["quantile_95"] < MAKERS_MRAD else "look", (
            f"Expected error of a colour's place on the surfaces, one sigma per axis: {figure(mm['median'])} mm in the "
            f"median, 95 % below {figure(mm['quantile_95'])} mm; as an angle {mrad['median']:.2f} and "
            f"{mrad['quantile_95']:.2f} mrad. Of the view alone, at {assessed.depth:.1f} m: "
            f"{figures['px']['median']:.2f} px = "
            f"{figure(figures['mm']['median'])} mm in the median, {figures['px']['largest']:.2f} px at worst."
        )
    text = (
        f"Expected position error over the photo, one sigma per axis: {figures['px']['median']:.2f} px = "
        f"{figure(figures['mm']['median'])} mm at {assessed.depth:.1f} m = {figures['mrad']['median']:.2f} mrad in the "
        f"median, {figures['px']['largest']:.2f} px = {figure(figures['mm']['largest'])} mm = "
        f"{figures['mrad']['largest']:.2f} mrad at worst."
    )
    word = "good" if figures["mrad"]["largest"] < MAKERS_MRAD else "look"
    return word, text


def _check_verdict(assessed: ViewAssessment) -> tuple[float | None, list[str]]:
    """The probability that counts, and the points that are off by themselves."""
    check = assessed.check or {}
    p = check.get("joint_p_value_of_the_others")
    return check.get("joint_p_value") if p is None else p, list(check.get("off", ())) if p is not None else []


def _of_disagreement(assessed: ViewAssessment) -> list[str]:
    said = []
    for agreement in assessed.agreement:
        if agreement.systematic and not agreement.explained:
            said.append(
                f"Remove the systematic difference ({agreement.title}, {agreement.size:.2f} px), which is more than "
                "the registration's own uncertainty: register again, with `--method sci --init` from here, or with "
                "better control points, and look at the overlay of edges."
            )
        elif agreement.systematic:
            said.append(
                f"The systematic difference ({agreement.title}, {agreement.size:.2f} px) is within what the "
                "registration's covariance allows; more control points, or `--method sci --init` from here, would "
                "remove it."
            )
    return said


def _of_points(assessed: ViewAssessment) -> list[str]:
    said = []
    a, e = assessed.adjustment or {}, assessed.evaluation
    if e and e.rejected:
        errors = {p.name: p for p in e.points}
        sizes = [
            f"{n} ({np.hypot(*errors[n].residual_xy):.1f} px off)" if np.isfinite(errors[n].residual_xy).all() else n
            for n in e.rejected[:8]
        ]
        more = f" and {len(e.rejected) - 8} more" if len(e.rejected) > 8 else ""
        said.append(
            f"Look again at {', '.join(sizes)}{more}: rejected as blunders. Were they pointed at in the wrong place, "
            "or paired with another point?"
        )
    dof = assessed.view.statistics.get("dof")
    if a and dof is not None and dof < FEW_FREEDOMS:
        said.append(
            f"Only {dof:g} redundant coordinates check the view: measure more control points, so that a blunder shows."
        )
    test = a.get("variance_test")
    sigma0 = assessed.view.statistics.get("sigma0")
    if test and not test["accepted"] and sigma0:
        if sigma0 > 1:
            said.append(
                f"The residuals are {sigma0:.1f} times what the stated sigmas promise (p = {test['p_value']:.1g}): the "
                "points were measured less well than stated, or the camera model does not fit (free `f`, `pp` or "
                "`distortion`). The covariance is scaled accordingly."
            )
        else:
            said.append(
                f"The residuals are only {sigma0:.2f} of what the stated sigmas promise (p = {test['p_value']:.1g}): "
                "state smaller sigmas; the covariance is scaled accordingly."
            )
    unchecked = [
        r["name"]
        for r in a.get("points", ())
        if r["status"] == "used" and (r["detectable"] is None or (r["effect"] or 0) > 20)
    ]
    if unchecked:
        few = ", ".join(unchecked[:6]) + (" …" if len(unchecked) > 6 else "")
        said.append(
            f"A blunder in {few} could stay unnoticed and move the picture by more than 20 px: measure a second point "
            "near each of them."
        )
    return said


def _of_checks(assessed: ViewAssessment) -> list[str]:
    e = assessed.evaluation
    p, off = _check_verdict(assessed)
    if off and e is not None:
        errors = {x.name: float(np.hypot(*x.residual_xy)) for x in e.points}
        named = ", ".join(f"{name} ({errors[name]:.2f} px off)" for name in off)
        return [
            f"Look again at {named} of the check points, which the view contradicts (each tested at {CHECK_ALPHA}), "
            f"while it agrees with the others (p = {p:.2g})."
        ]
    if p is not None and p < 0.01:
        return [
            f"The check points contradict the covariance (p = {p:.1g}): something is systematically wrong, in the "
            "points' frame, the camera model, or in points that nothing else controls."
        ]
    if e and e.control and e.check is None and not assessed.agreement:
        return [
            "Keep three or more points out of the estimate (role `check`), or give `--cloud`: the residuals of control "
            "points say how well the estimate fits, not how accurate it is."
        ]
    return []


def _of_the_next_point(assessed: ViewAssessment) -> list[str]:
    if not assessed.next_points:
        return []
    said = []
    m = assessed.error_map
    if m is not None:
        middle = m.pixels[m.pixels.shape[0] // 2, m.pixels.shape[1] // 2]
        largest = float(np.nanmax(m.pixels))
        if assessed.view.points and largest > UNEVEN * middle:
            said.append(
                f"The corners are worse than the middle ({largest:.2f} against {middle:.2f} px): the points do not "
                "hold the borders of the photo."
            )
    first = assessed.next_points[0]
    before, after = first.mean_px
    if after < (1 - WORTHWHILE) * before:
        worst = first.largest_px
        place = "over the photo" if assessed.surface is None else "on the surfaces, near ones too,"
        said.append(
            f"The next control point would help most {first.where}: the expected error {place} would go from "
            f"{before:.2f} to {after:.2f} px in the mean, from {worst[0]:.2f} to {worst[1]:.2f} px at worst."
        )
    return said
