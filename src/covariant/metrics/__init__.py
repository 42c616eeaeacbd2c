"""Contraction metrics of general nonlinear systems, from a Riccati equation solved along characteristics.

For `x' = f(x)`, `y = h(x)` a metric P with

    L_f P = dhᵀ R⁻¹ dh − λ P − P Q P,      L_f P = Ṗ + P f_x + f_xᵀ P,

makes f contract in every direction tangent to the level sets of the output; output injection can then make it contract
in all directions. P(x) measures how well the past output determines the state x: with λ alone it is the weighted
Gramian of the past, with Q alone the information matrix of a stationary Kalman filter.

Source: Sanfelice & Praly 2015, Solution of a Riccati equation for the design of an observer contracting a Riemannian
distance.

On grids of states, metrics are computed block by block on Dask, stored in Zarr and read through xarray. A grid may have
far more points than fit in memory, since only the blocks being computed are loaded. A run that was killed continues
where it stopped. Dask, Zarr and xarray are optional packages, installed by `pip install 'covariant[scale]'`.

    grid = Grid(("angle", "rate"), ("rad", "rad/s"), low=(-3.0, -5.0), high=(3.0, 5.0), counts=(601, 1001))
    energy = Variable((), "J", "energy of the pendulum")
    path = map_grid(lambda x: {"energy": x[1] ** 2 / 2 - jnp.cos(x[0])}, grid, "energy.zarr",
                    variables={"energy": energy}, provenance={"model": "pendulum"})
    open_grid(path, complete=True).energy.sel(rate=0.0).max()
"""

from scalargraph.rooms import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
