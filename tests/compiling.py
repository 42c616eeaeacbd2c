"""How the few programs of tests are compiled that compute for long: to run fast, not to be made quickly as the others.

`conftest.py` tells how those are made.
"""

import functools

import equinox as eqx

optimised = functools.partial(
    eqx.filter_jit,
    compiler_options={
        "xla_backend_optimization_level": 2,
        "xla_cpu_use_fusion_emitters": True,
        "xla_disable_hlo_passes": "",
    },
)
"""As `equinox.filter_jit`; compiling takes half as long again, running a third of the time."""
