"""Printed equations, evaluated as text, are those of the paper and of the observer that runs."""

import re

import jax.numpy as jnp
import numpy as np
import pytest

from covariant import models, verbs
from covariant.observers import Intrinsic

ALPHA, BETA = 1.4, 0.6


def evaluated(markdown: str, values: dict[str, float]) -> dict[str, float]:
    """Values of all equations of a text but that of the metric, in their order, with those that were given."""
    values = values | {r"\alpha": ALPHA, r"\beta": BETA}
    for block in re.findall(r"\$\$\n(.*?)\n\$\$", markdown, re.DOTALL):
        *symbols, text = block.split(" = ")
        if "pmatrix" not in text:
            values |= dict.fromkeys(symbols, number(text, values))
    return values


def number(latex: str, values: dict[str, float]) -> float:
    names = sorted(values, key=len, reverse=True)  # \hat{r} before r
    for k, name in enumerate(names):
        latex = re.sub(rf"(?<![A-Za-z\\]){re.escape(name)}(?![A-Za-z])", chr(0xE000 + k), latex)
    latex = re.sub("[\ue000-\uf8ff]", lambda match: f"x{ord(match[0]) - 0xE000}", latex)
    for old, new in ((r"\frac{", "("), ("}{", ")/("), ("^{", "**("), ("{", "("), ("}", ")"), (r"\,", "*"), ("\\", "")):
        latex = latex.replace(old, new)
    return eval(latex, vars(np) | {f"x{k}": values[name] for k, name in enumerate(names)})


def drawn(symbols: list[str], rng, size: float) -> dict[str, float]:
    """Random values of all that the equations of these coordinates have on their right sides."""
    of = {form % x: rng.normal() for x in symbols for form in ("%s", r"\hat{v}_{%s}", "v_{%s}", r"\xi_{%s}")}
    return of | {hat(x): of[x] + size * rng.normal() for x in symbols}


def hat(symbol: str) -> str:
    return re.sub(r"^(\\?\w+?)(_.*)?$", r"\\hat{\1}\2", symbol)


def check_observer(model, name, symbols, inputs):
    """The printed observer has the rates of `Intrinsic`."""
    printed, rng = verbs.describe_model(name, equations=True).facts["equations"], np.random.default_rng(0)
    observer = Intrinsic(model, ALPHA, BETA)
    for _ in range(10):
        given = drawn(symbols, rng, 0.4) | {u: rng.normal() for u in inputs}
        y, q, v, u = (
            jnp.array([given[key] for key in keys])
            for keys in (symbols, map(hat, symbols), [rf"\hat{{v}}_{{{x}}}" for x in symbols], inputs)
        )
        rates = observer.flow(jnp.zeros(()), observer.init(q, 0.0)._replace(v=v), u, y)
        values = evaluated(printed, given)
        found = [values[re.sub(r"^(\\hat\{.*?\})(_.*)?$", r"\\dot{\1}\2", hat(x))] for x in symbols]
        found += [values[rf"\dot{{\hat{{v}}}}_{{{x}}}"] for x in symbols]
        np.testing.assert_allclose(found, [*rates.q, *rates.v], rtol=1e-12, atol=1e-12)
    return printed


def test_the_ball_and_beam_is_printed_as_in_the_paper():
    printed = check_observer(models.ball_and_beam(), "ball_and_beam", ["r", r"\theta"], ["u_{1}"])
    assert r"g = \begin{pmatrix} 1 & 0 \\ 0 & 1 + r^{2} \end{pmatrix}" in printed
    assert r"\Gamma^{\theta}_{r \theta} = \Gamma^{\theta}_{\theta r} = \frac{r}{1 + r^{2}}" in printed
    assert r"\Gamma^{r}_{\theta \theta} = -r" in printed
    rng = np.random.default_rng(1)
    for size in (0.0, 0.5):
        given = drawn(["r", r"\theta"], rng, size) | {"u_{1}": rng.normal()}
        values = evaluated(printed, given)
        r, th, rh, vr, vth, u = (
            given[key] for key in ("r", r"\theta", r"\hat{r}", r"\hat{v}_{r}", r"\hat{v}_{\theta}", "u_{1}")
        )
        e_r, e_th = rh - r, given[r"\hat{\theta}"] - th
        w_r, w_th, torque = vr - ALPHA * e_r, vth - ALPHA * e_th, (u - r * np.cos(th)) / (1 + r**2)
        # (14) with coefficients of the error terms at r, as in (5), and the curvature with the sign of (5).
        at, square = r / (1 + r**2), 1 + r**2
        v_r = rh * w_th * vth - np.sin(th) + r * e_th * torque - BETA * e_r
        v_r += (vr * vth * e_th - vth**2 * e_r) / square
        v_th = -rh / (1 + rh**2) * (w_r * vth + vr * w_th) + torque - at * (e_r * torque - e_th * np.sin(th))
        v_th += -BETA * e_th + (-(vr**2) * e_th + vr * vth * e_r) / square**2
        assert values[r"\dot{\hat{v}}_{r}"] == pytest.approx(v_r, abs=1e-12)
        assert values[r"\dot{\hat{v}}_{\theta}"] == pytest.approx(v_th, abs=1e-12)
        if size == 0.0:  # without an error the observer is the system (13)
            assert v_r == pytest.approx(r * vth**2 - np.sin(th), abs=1e-12)
            assert v_th == pytest.approx(-2 * at * vr * vth + torque, abs=1e-12)


def test_a_pendulum_chain_with_friction_is_printed_as_it_is_observed(tmp_path):
    path = tmp_path / "chain.toml"
    path.write_text(
        'system = "pendulum_chain"\n[parameters]\nmass = [1.0, 0.7]\nlength = [0.5, 0.4]\nviscous = [0.1, 0.03]\n'
        "coulomb = [0.02, 0.0]\n"
    )
    chain = models.pendulum_chain((1.0, 0.7), (0.5, 0.4), viscous=(0.1, 0.03), coulomb=(0.02, 0.0))
    printed = check_observer(chain, path, ["q_{1}", "q_{2}"], ["u_{1}", "u_{2}"])
    assert "differences of angles between −π and π" in printed


@pytest.mark.parametrize(
    ("model", "reason"),
    [
        ("heavy_top", "has attitudes"),
        ("panda", "more than 400 operations"),
        ("lorenz", "state-space model"),
        (models.Lagrangian(lambda q: jnp.eye(2), coordinates=("x", "beta")), "have one symbol"),
        (models.Lagrangian(lambda q: jnp.eye(2), coordinates=("theta1", "theta_1")), "have one symbol"),
    ],
)
def test_what_cannot_be_printed_is_refused_in_one_line(model, reason):
    with pytest.raises(ValueError, match=reason) as refusal:
        verbs.describe_model(model, equations=True)
    assert "\n" not in str(refusal.value)
    assert "`covariant " in str(refusal.value)
