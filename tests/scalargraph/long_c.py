"""C of a graph computes what the graph says, and its text is the same everywhere: what takes long."""

import math
import subprocess

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_c import COMPILER, compiled, in_lanes

from scalargraph import LoweringError, lower, numbers
from scalargraph.c import simplified

pytestmark = pytest.mark.skipif(COMPILER is None, reason="there is no C compiler, `cc`")


@pytest.mark.exhaustive
def test_the_text_does_not_depend_on_the_order_of_sets():
    script = (
        "import sys; sys.path.insert(0, sys.argv[1])\n"
        "from test_c import every_operation, graph_of\n"
        "from scalargraph import c_function, c_helpers, c_rows\n"
        "print(c_rows(graph_of(every_operation, 4), 'g', 8))\n"
        "text = c_function(graph_of(every_operation, 4), 'f', most_statements=20)\n"
        "print(c_helpers(text.helpers), text.text)"
    )
    folder = os.path.dirname(__file__)
    texts = {
        subprocess.run(
            [sys.executable, "-c", script, folder],
            env=os.environ | {"PYTHONHASHSEED": seed},
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        for seed in ("1", "2")
    }
    assert len(texts) == 1
    assert "void f(" in texts.pop()


@pytest.mark.exhaustive
def test_a_loop_whose_length_the_arguments_decide_is_one_of_c(tmp_path):
    """Within another loop, and among values that other parts of the function use."""

    def walk(x):
        """Steps of a map until a number is small, weighted by a sum that an inner loop makes; one entry never moves."""

        def turn(carry):
            k, value, total, still = carry
            both = (0.0, value)
            inner, more = jax.lax.fori_loop(0, k, lambda i, s: (s[0] + jnp.sin(value * i) * x[1], s[1] * 0.5), both)
            return k + 1, value * 0.6, total + inner - more, still

        k, _, total, still = jax.lax.while_loop(lambda c: c[1] > x[2], turn, (0, x[0], x[1], jnp.array([3.0, 0.0])))
        return jnp.array([1.0 * k, total, *still, jnp.tanh(total) + x[2]])

    points = np.array([[9.0, 0.3, 0.5], [0.1, 2.0, 0.5], [1e4, -1.0, 1e-3], [math.nan, 1.0, 1.0]])
    expected = np.stack([np.asarray(walk(jnp.asarray(p))) for p in points])
    lowered = lower(walk, points[0], loops="any")
    with pytest.raises(LoweringError, match="give it a fixed length"):
        lower(walk, points[0])
    np.testing.assert_allclose(numbers(lowered, points), expected, rtol=1e-12)  # lanes of different lengths
    np.testing.assert_allclose(numbers(simplified(lowered), points), expected, rtol=1e-12)
    for most in (500, 3):
        (tmp_path / str(most)).mkdir()
        call, text = compiled(lowered, tmp_path / str(most), most_statements=most)
        np.testing.assert_allclose([call(p) for p in points], expected, rtol=1e-12)
    np.testing.assert_allclose(in_lanes(lowered, tmp_path, most_statements=3)(points), expected, rtol=1e-12)
    assert text.count("for (;;)") == 2
    assert "y[2] = 3.0;" in text, "what never moves is not carried"
