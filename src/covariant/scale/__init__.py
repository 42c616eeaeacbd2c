"""Functions of one state over big grids: computed block by block on Dask, kept in Zarr, read through xarray.

A grid may hold far more points than memory does: only the blocks being computed are there. A killed run goes on where
it stopped. Dask, Zarr and xarray are guests: the functions load them, and `pip install 'covariant[scale]'` brings them.

    grid = Grid(("angle", "rate"), ("rad", "rad/s"), low=(-3.0, -5.0), high=(3.0, 5.0), counts=(601, 1001))
    energy = Variable((), "J", "energy of the pendulum")
    path = map_grid(lambda x: {"energy": x[1] ** 2 / 2 - jnp.cos(x[0])}, grid, "energy.zarr",
                    variables={"energy": energy}, provenance={"model": "pendulum"})
    open_grid(path, complete=True).energy.sel(rate=0.0).max()
"""

from covariant.scale._grid import Grid
from covariant.scale._map import map_grid
from covariant.scale._store import Variable, open_grid

__all__ = ["Grid", "Variable", "map_grid", "open_grid"]
