"""A registration of one view with what speaks for and against it, for people and for machines."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ..evaluate import ViewEvaluation, table
from ..io.registration import write_registration
from ..model import Covariance, Registration, View


@dataclass(frozen=True)
class RegisterResult:
    """A registration of one view, how well it fits, and every doubt about it."""

    registration: Registration
    evaluation: ViewEvaluation | None
    notes: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    doubts: tuple[str, ...] = ()
    free: tuple[str, ...] = ()
    facts: dict[str, Any] = field(default_factory=dict)

    @property
    def trusted(self) -> bool:
        """Whether nothing speaks against using the view. ``doubts`` says what does; ``warnings`` are to be read too."""
        return not self.doubts

    @property
    def view(self) -> View:
        """The estimated view."""
        return self.registration.views[0]

    def save(self, path: str | Path) -> None:
        """Writes the registration, atomically."""
        write_registration(path, self.registration)

    def text(self) -> str:
        """A few lines for people."""
        view = self.view
        s = view.statistics
        lines = [*self.notes]
        if self.evaluation is not None:  # matches with the SCI are no points to be evaluated at
            lines.append(table([self.evaluation]))
        if "sigma0" in s:
            lines.append(f"sigma0 {s['sigma0']:.3f}, {s['dof']:g} degrees of freedom")
        elif "dof" in s:
            lines.append(f"{s['dof']:g} degrees of freedom: nothing checks the fit")
        place = view.core.centre
        lines.append(f"projection centre {place[0]:.4f} {place[1]:.4f} {place[2]:.4f}")
        if view.covariance is not None:
            lines += _sigma_lines(view.covariance)
        if view.camera is not None and view.camera.params:
            lines.append("camera " + "  ".join(f"{k} {v:.6g}" for k, v in view.camera.params.items()))
        lines += [f"{key}: {value}" for key, value in self.facts.items()]
        lines += [f"warning: {warning}" for warning in self.warnings]
        lines += [f"DOUBT: {doubt}" for doubt in self.doubts]
        if self.doubts:
            lines.append("VERDICT: do not use this view before somebody has looked at it")
        return "\n".join(lines)

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        view = self.view
        return {
            "trusted": self.trusted,
            "doubts": list(self.doubts),
            "warnings": list(self.warnings),
            "notes": list(self.notes),
            "free": list(self.free),
            "method": view.method,
            "centre": view.core.centre.tolist(),
            "rotation": view.core.rotation.tolist(),
            "camera": dict(view.camera.params) if view.camera else None,
            "dlt": view.dlt.tolist() if view.dlt is not None else None,
            "sigmas": {n: view.covariance.sigma(n) for n in view.covariance.parameters} if view.covariance else None,
            "statistics": dict(view.statistics),
            "evaluation": self.evaluation.as_dict() if self.evaluation is not None else None,
            **self.facts,
        }


def _sigma_lines(covariance: Covariance) -> list[str]:
    names = covariance.parameters
    lines = []
    if "cx_world" in names:
        place = [1000 * covariance.sigma(n) for n in ("cx_world", "cy_world", "cz_world") if n in names]
        lines.append("  sigma of the centre " + "  ".join(f"{v:.2f}" for v in place) + " mm")
    if "rx" in names:
        turn = [1000 * covariance.sigma(n) for n in ("rx", "ry", "rz") if n in names]
        lines.append("  sigma of the rotation " + "  ".join(f"{v:.4f}" for v in turn) + " mrad")
    return lines
