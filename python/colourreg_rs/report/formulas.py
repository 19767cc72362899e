"""Every figure of the report with its formula and its source."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Formula:
    """A figure, how it is made, and who published it."""

    name: str
    formula: str
    source: str


FORMULAS = (
    Formula("RMS (per coordinate)", "√(Σ(vx² + vy²) / 2n), v = computed − measured", "standard"),
    Formula("RMSE (radial)", "√(Σ(vx² + vy²) / n)", "standard"),
    Formula("estimate", "Gauss–Helmert adjustment, linearised at the adjusted observations", "Pope 1972"),
    Formula("σ₀ (sigma0)", "√(vᵀ Σ⁻¹ v / dof): one where the stated sigmas are right", "Helmert 1907"),
    Formula("variance factor test", "dof · σ₀² against χ²(dof), two-sided", "Koch 1999, ch. 4"),
    Formula("redundancy number r", "diagonal of Σ Bᵀ W⁻¹ Q_w W⁻¹ B: how much of an error shows", "Baarda 1968"),
    Formula("test T of a point", "wᵀ Q_w⁻¹ w / 2 of the point's misclosure, χ² or F", "Baarda 1968; Pope 1976"),
    Formula("data snooping", "the worst point is left out and all is adjusted again", "Baarda 1968"),
    Formula("minimal detectable bias", "∇ᵀ S ∇ = λ₀(α, power), in the worst direction", "Baarda 1968"),
    Formula("its effect", "largest shift over the photo by a bias of that size", "Baarda 1968"),
    Formula("leave-one-out residual", "W Q_w⁻¹ w: against the estimate without the point", "Cook 1977"),
    Formula("variance components", "iterated estimate for photo and object", "Helmert 1907; Förstner 1979"),
    Formula("correlation", "q_ij / √(q_ii q_jj)", "standard"),
    Formula("expected position error", "J Σ Jᵀ over the photo; one sigma per axis, √(trace / 2)", "error propagation"),
    Formula("next control point", "Q − Q aᵀ (W + a Q aᵀ)⁻¹ a Q, least mean error", "Fedorov 1972"),
    Formula("ColourSigma", "(J_u Σ_u J_uᵀ + J_X Σ_X J_Xᵀ + Σ_image) on the tangent plane", "error propagation"),
    Formula("shift of a patch", "oriented gradients, sub-pixel peak", "Ye et al. 2019"),
    Formula("systematic field", "shift, rotation, scale; sandwich covariance of correlated matches", "Conley 1999"),
)
