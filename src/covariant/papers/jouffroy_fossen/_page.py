"""Writes the text and tables of the reproduction of Jouffroy & Fossen 2004."""

import math
from pathlib import Path
from typing import Any

from covariant.papers.jouffroy_fossen._sea import SETTLED


def summary(results: dict[str, Any]) -> list[str | list[dict[str, str]]]:
    """Lines and tables to print, from the results of `reproduce`."""
    ship, odin, three = results["ship"], results["odin"], results["theorem3"]
    c = three["constants"]
    return [
        f"Ship (53): largest real part {ship['eigenvalues']['printed']:+.3f} with K2 as printed in (54), "
        f"{ship['eigenvalues']['corrected']:+.3f} as corrected; Q ≥ αP guarantees {ship['rate']:.2e} 1/s, (47) in SI "
        f"units {ship['printed']:.2e} 1/s, {ship['fitted']:.2e} 1/s was measured",
        "Theorem 2: what the print says, and what happens",
        [
            {
                "system": name,
                "printed Jacobian [1/s]": f"{case['printed']:+.2f}",
                "true error [1/s]": f"{case['true']:+.2f}",
                "proof of contraction": case["proof"],
            }
            for name, case in results["theorem2"].items()
        ],
        "ODIN, observer (101)–(102)",
        [
            {"K2": name, "largest real part at rest [1/s]": f"{value:+.3f}"}
            for name, value in odin["eigenvalues"].items()
        ],
        [{"metric": name, "least rate found [1/s]": f"{rate:.2e}"} for name, rate in odin["sampled"].items()],
        f"Certified rate of squared lengths: {odin['certified']['rate']:g} 1/s ({odin['certified']['verdict']}, "
        f"{odin['certified']['boxes']} boxes) over {odin['certified']['domain']}, so that errors fall at half "
        f"of it or faster; measured: observer {odin['loop']['observer']:.3f} 1/s, tracking "
        f"{odin['loop']['tracking']:.3f} 1/s",
        f"With a quaternion, turned over its nose: pitch up to {results['somersault']['largest_pitch']:.1f}°, past 80° "
        f"{results['somersault']['times_past_80_degrees']} times; after 30 s the error of the observer is "
        f"{results['somersault']['observer_last']:.1e}, that of tracking {results['somersault']['tracking_last']:.1e}",
        "Theorem 3 on ODIN, K_p = 100, K_d = 200, Λ = 0.5",
        [
            {"": "sampled"} | {name: f"{value:.4g}" for name, value in c.items()},
            {"": "from M, K_p, K_d, Λ"} | {name: f"{value:.4g}" for name, value in three["closed_form"].items()},
        ],
        f"(72) as printed: γ1² = {three['gamma1_squared']:.4g}, bound {three['bound']:.4g}: "
        f"{'holds' if three['printed'] else 'fails'}; weighted: {'holds' if three['weighted'] else 'fails'} with "
        f"κ > {three['kappa']:.4g}; in other units as printed: "
        + ", ".join(f"{name} {'holds' if ok else 'fails'}" for name, ok in three["units"].items()),
        f"Dynamic positioning, velocity errors (RMSE) after {SETTLED:g} s",
        sea_rows(results["sea"]),
    ]


def sea_rows(table: dict[str, dict[str, float]]) -> list[dict[str, str]]:
    """Rows of the table that compares the estimators at sea.

    Args:
        table: As from `sea_table`, with each estimator's `cost` of a sample [µs].

    Returns:
        One row for each estimator.
    """
    return [
        {
            "estimator": name,
            "surge [m/s]": f"{row['surge']:.4f}",
            "sway [m/s]": f"{row['sway']:.4f}",
            "yaw rate [deg/s]": f"{math.degrees(row['yaw_rate']):.4f}",
            "in the gaps [m/s]": f"{row['gaps']:.4f}",
            "a sample [µs]": f"{row['cost']:.1f}",
        }
        for name, row in table.items()
    ]


TITLE = "Jouffroy & Fossen 2004, reproduced"


def page(results: dict[str, Any], figures: tuple[Path, ...]) -> list[Any]:
    """Explanations, tables and figures, one below the other, of the results of `reproduce` and the files of `draw`."""
    ship, _, theorem2, _, eigen, sampled, certified, turned, _, constants, verdicts, _, table = summary(results)
    return [
        "# The ship",
        str(ship) + ".",
        "# Theorem 2",
        "The print differentiates the input's dependence on the estimate. It acts on the plant too, and cancels: "
        "what has to contract is the virtual system, at fixed input and measurement.",
        theorem2,
        "# ODIN under output feedback",
        "K2 = I − K_p makes the true error unstable. A symmetric positive definite K2 makes it converge; but drag "
        "that is quadratic vanishes at rest, so that the metric diag(K2, M) proves no rate there. With a cross "
        "term it does.",
        eigen,
        sampled,
        str(certified) + ".",
        figures[0],
        str(turned) + ".",
        "# Theorem 3",
        constants,
        str(verdicts) + ".",
        "# Dynamic positioning",
        "A supply vessel in waves, pushed by slowly varying forces, its compass at 10 Hz and GNSS at 1 Hz with two "
        "gaps. The filter knows the densities of all noises; the passive observer has constant gains and a proof; "
        "the filtered derivative knows nothing and takes waves for motion.",
        table,
        figures[1],
    ]
