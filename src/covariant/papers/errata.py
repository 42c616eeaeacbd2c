"""Lists misprints of the four papers: each as printed, as it should read, and with a test that shows the difference.

These formulas are stored only here; the pages of the papers and the keys of the counter-examples in
`covariant.papers._errata` use them. Differences of convention (the sign of the curvature, α or 2α) do not count as
misprints; they are in the table of symbols, `docs/notation.md`.
"""

from typing import NamedTuple


class Erratum(NamedTuple):
    """A printed formula that is wrong if it is implemented literally.

    Attributes:
        paper: Name of the paper, as `covariant reproduce` takes it.
        where: Equation or place in the paper.
        printed: The formula as printed.
        corrected: The formula as it should read.
        reason: What is wrong, in a few words.
        effect: Consequence for someone who implements the printed formula.
        shown_by: The test that fails with the printed formula, as `path::function`, from the repository's root.
        slip: Key in `covariant.papers._errata.SLIPS` of the counter-example; empty if there is none.

    Example:
        >>> from covariant.papers.errata import ERRATA
        >>> first = ERRATA[0]
        >>> first.paper, first.where
        ('aghannan-rouchon', '(14)')
    """

    paper: str
    where: str
    printed: str
    corrected: str
    reason: str
    effect: str
    shown_by: str
    slip: str = ""


_GROUPS = "tests/laws/test_group_observers.py::test_each_slip_of_the_print_breaks_the_linear_law"
_ERRATA = "tests/reference/test_errata.py"
_FOSSEN = "tests/reference/long_jouffroy_fossen.py"
_CASCADE = "tests/certificates/test_cascade.py"

ERRATA: tuple[Erratum, ...] = (
    Erratum(
        "aghannan-rouchon",
        "(14)",
        "in v̂_r': (−v̂_r v̂_θ e_θ + v̂_θ² e_r)/(1 + r̂²); in v̂_θ': (v̂_r² e_θ − v̂_r v̂_θ e_r)/(1 + r̂²)², e = q̂ − q",
        "in v̂_r': (v̂_r v̂_θ e_θ − v̂_θ² e_r)/(1 + r̂²); in v̂_θ': (−v̂_r² e_θ + v̂_r v̂_θ e_r)/(1 + r̂²)²",
        "all four curvature terms have the sign opposite to equation (5) of the same paper",
        "the observer diverges in the scenario of figure 4: the error is 1.2 after 10 s and 509 after 40 s, where the "
        "corrected one is at 0.043 and 1.4e-10",
        "tests/laws/test_observers.py::test_the_printed_ball_and_beam",
    ),
    Erratum(
        "aghannan-rouchon",
        "dV/dt, below (11)",
        "V' = −<ξ, ξ> − <ζ, ζ>",
        "V' = −½(<ξ, ξ> + <ζ, ζ>)",
        "a factor ½, since V is half of a squared length and Q solves AᵀQ + QA = −I",
        "the rate λ read off the print is 0.770 1/s for figure 4, twice the best that holds, 0.385 1/s",
        f"{_ERRATA}::test_the_lyapunov_function_falls_at_half_the_printed_rate",
    ),
    Erratum(
        "maithripala",
        "(6), (8)",
        "R(ζ, η)Ω = e_k (R^k_jab Ω^j (ζ^a η^b − ζ^b η^a) − ω^k_ij C^i_ab ζ^a η^b Ω^j)",
        "R(ζ, η)Ω = ½ e_k R^k_jab Ω^j (ζ^a η^b − ζ^b η^a), which is ω(ζ, ω(η, Ω)) − ω(η, ω(ζ, Ω)) − ω([ζ, η], Ω)",
        "parts of the curvature are counted twice: the print is 2R(ζ, η)Ω − ω([ζ, η], Ω)",
        "on a bi-invariant SO(3) the curvature is four times too large",
        _GROUPS,
        "curvature count",
    ),
    Erratum(
        "maithripala",
        "(18), (21), (29), (42), (43)",
        "ζ̃' = … + R(ζ̃, ζ_e)ζ̃ − βζ_e",
        "ζ̃' = … − R(ζ̃, ζ_e)ζ̃ − βζ_e",
        "with the curvature of (5), which is that of this library, the term enters with a minus",
        "an elongated top still converges, since its curvature is positive; with (8) as printed too, a tumbling disc "
        "is off by 1.4 rad/s after 10 s, where the corrected observer is off by 0.061",
        _GROUPS,
        "curvature sign",
    ),
    Erratum(
        "maithripala",
        "(19)",
        "Γ(S, ζ_e) = (S^k − ω^k_ij S^i ζ_e^j) e^k",
        "Γ(S, ζ_e) = (S^k − ω^k_ij ζ_e^i S^j) e_k",
        "the arguments of the connection are exchanged",
        "ζ̃' is off by [S, ζ_e], which is of first order in the error",
        _GROUPS,
        "transport",
    ),
    Erratum(
        "maithripala",
        "(21)",
        "ζ̃' = … + [ζ_e, ζ̃] + …",
        "ζ̃' = … + α[ζ_e, ζ̃] + …",
        "the bracket lacks its factor α, which it has in (29), (42) and (43)",
        "ζ̃' is off by (α − 1)[ζ_e, ζ̃]",
        _GROUPS,
        "alpha",
    ),
    Erratum(
        "maithripala",
        "(44), (45)",
        "Ω_e = ψ/(2 sin ψ) (R̃Rᵀ − RR̃ᵀ), v_e = W⁻¹(Rᵀb̃ − R̃ᵀb)",
        "Ω_e = ψ/(2 sin ψ) (RᵀR̃ − R̃ᵀR), v_e = W⁻¹Rᵀ(b̃ − b)",
        "not the logarithm of g⁻¹g̃: one is the rotation vector in space, the other subtracts vectors of two frames",
        "the correction of the attitude is turned by the attitude itself: it is right at the identity only",
        _GROUPS,
        "logarithm",
    ),
    Erratum(
        "maithripala",
        "below (30), below (45)",
        "S = f^c + Σ u_i f^i",
        "S = I⁻¹(f^c + Σ u_i f^i), as in (14)",
        "S lacks the inverse inertia, and has the unit of a torque where an acceleration belongs",
        "the true motion is no solution of the observer",
        _GROUPS,
        "source",
    ),
    Erratum(
        "maithripala",
        "(9)–(11)",
        "d(g̃, g) = ‖ζ_e‖ and grad F = g̃ζ_e, for any left-invariant metric",
        "both hold for bi-invariant metrics; else grad F = g̃(ζ_e + ½I⁻¹ad*_{ζ_e}Iζ_e) + O(‖ζ_e‖³)",
        "the group logarithm is a geodesic of bi-invariant metrics only",
        "the local rate is the same, since the difference is of second order; rotations of 1 rad are measured too long",
        "tests/reference/long_maithripala.py::test_the_group_logarithm_is_too_long_and_aside",
    ),
    Erratum(
        "sanfelice-praly",
        "(10)",
        "L_f α = −f_xᵀ α + h_x h_xᵀ β",
        "L_f α = −f_xᵀ α + h_xᵀ h_x β",
        "a transpose: the printed product has the size of the output and not of the state",
        "it cannot be evaluated for n ≠ p",
        f"{_ERRATA}::test_radons_pair_solves_the_riccati_equation",
    ),
    Erratum(
        "sanfelice-praly",
        "image of F, below (21)",
        "F̃ = φ_x⁻¹ J' φ_x⁻¹ π φ_x⁻¹ − φ_x⁻¹ π φ_x⁻¹ J' φ_x⁻¹ + φ_x⁻¹ F φ_x⁻¹, J' = Σ (∂φ/∂x_i) f_i",
        "F̃ = −φ_x⁻ᵀ J'ᵀ φ_x⁻ᵀ π φ_x⁻¹ − φ_x⁻ᵀ π φ_x⁻¹ J' φ_x⁻¹ + φ_x⁻ᵀ F φ_x⁻¹, J' = Σ (∂φ_x/∂x_i) f_i",
        "the first sign, transposes, and the second derivatives of φ are missing",
        "the metric in other coordinates is not symmetric",
        f"{_ERRATA}::test_image_of_the_riccati_field_in_other_coordinates",
    ),
    Erratum(
        "sanfelice-praly",
        "algorithm, step 2, and figure 1",
        "stop at exp(−λT̄) ≤ 1e-4 with π(−T̄) = 5 I",
        "stop at exp(−λT̄) ≤ 1e-12, or start with a small π(−T̄), and measure the error relative to P",
        "the largest error of an entry says nothing of the directions in which P is small",
        "at λ = 8 every entry is right to 1e-3, and the metric is some 700 times too large in its weakest direction",
        "tests/reference/long_sanfelice_praly.py::test_small_entries_hide_a_metric_that_is_far_off",
    ),
    Erratum(
        "sanfelice-praly",
        "above (20)",
        "the n-dimensional cone of symmetric positive definite matrices",
        "the cone of dimension n(n + 1)/2",
        "the dimension",
        "none for the algorithm",
        f"{_ERRATA}::test_dimension_of_symmetric_matrices",
    ),
    Erratum(
        "jouffroy-fossen",
        "Theorem 2, (16), (20), (25), Example 1, F_con",
        "F = ∂f(x̂, β(x̂), t)/∂x̂ − K ∂h/∂x̂ is uniformly negative definite",
        "F = ∂f/∂x(x̂, u, t) − K ∂h/∂x̂ is, at fixed u",
        "plant and observer have the same input, so that its dependence on the estimate cancels",
        "A = B = 1, G = −3, C = 1, K = ½ is called contracting at −2.5 1/s, and the error grows at +0.5 1/s",
        f"{_CASCADE}::test_print_of_theorem_2_says_the_opposite_of_what_happens",
    ),
    Erratum(
        "jouffroy-fossen",
        "(18)",
        "V' = δx̂ᵀ(F + Fᵀ)δx̂ ≤ −σ|δx̂|²",
        "V' = ½ δx̂ᵀ(F + Fᵀ)δx̂ ≤ −½σ|δx̂|²",
        "a factor ½, since V = ½ δx̂ᵀδx̂",
        "the rate is twice the true one",
        f"{_ERRATA}::test_rate_of_half_a_squared_length",
    ),
    Erratum(
        "jouffroy-fossen",
        "(54)",
        "K2 = A1 − Rᵀ(ψ)",
        "K2 = A1 + Rᵀ(ψ), where also A2 + A2ᵀ < 0",
        "a sign",
        "the error of the supply vessel is unstable: its largest real part is +0.60 and not −0.52, in its scaled time",
        f"{_FOSSEN}::test_printed_gain_of_the_ship_is_unstable_and_the_corrected_one_is_not",
    ),
    Erratum(
        "jouffroy-fossen",
        "(59)",
        "A2ᵀP2 + P2A2 > 0",
        "A2ᵀP2 + P2A2 < 0",
        "a sign",
        "no P2 > 0 satisfies the print for an A2 that is Hurwitz",
        f"{_ERRATA}::test_no_lyapunov_matrix_has_the_printed_sign",
    ),
    Erratum(
        "jouffroy-fossen",
        "F_obs",
        "−diag(d_i |ν̂_i|)",
        "−2 diag(d_i |ν̂_i|)",
        "a factor 2, the derivative of d|ν|ν",
        "the drag damps errors twice as much as the print says",
        f"{_ERRATA}::test_slope_of_a_quadratic_drag",
    ),
    Erratum(
        "jouffroy-fossen",
        "gains of ODIN, below F_con",
        "K2 = I − K_p",
        "K2 = K2ᵀ > 0, whatever K_p is",
        "F_con does not enter the error of the observer, so K_p cannot compensate K2",
        "with K_p > I the true error is unstable, with a largest real part of +2.3 1/s at rest, and stays of order one",
        f"{_FOSSEN}::test_printed_gain_of_odin_is_unstable_and_its_observer_does_not_converge",
    ),
    Erratum(
        "jouffroy-fossen",
        "γ1",
        "γ1 bounds the coupling without Jᵀ",
        "γ1 bounds Jᵀ times it; the two are equal for orthogonal J only",
        "T_Θ is not orthogonal in Euler angles",
        "for ODIN, rolled and pitched by 0.5 rad, γ1 is 30.8 and not 28.4",
        f"{_FOSSEN}::test_gamma_1_is_the_norm_of_the_coupling",
    ),
    Erratum(
        "jouffroy-fossen",
        "(72)",
        "γ1² < 4(c3 − c4γ2)λ_q/c4²",
        "γ2 < c3/c4 alone, with V = V_con + κV_obs and κ > (c4γ1)²/(4λ_q(c3 − c4γ2))",
        "sufficient, and its verdict depends on the units",
        "a controller that is stable with the observer may be refused",
        "tests/certificates/long_cascade.py::test_printed_verdict_depends_on_units_and_the_weighted_one_does_not",
    ),
)
"""All misprints, by paper and in the order in which they matter."""


def of(paper: str) -> tuple[Erratum, ...]:
    """Misprints of one paper.

    Args:
        paper: Name of the paper, as in `Erratum.paper`.

    Returns:
        Its entries of `ERRATA`.

    Example:
        >>> from covariant.papers import errata
        >>> [entry.where for entry in errata.of("sanfelice-praly")][:2]
        ['(10)', 'image of F, below (21)']
    """
    return tuple(entry for entry in ERRATA if entry.paper == paper)
