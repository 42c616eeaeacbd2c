from ._grid import Grid as Grid
from ._map import map_grid as map_grid
from ._store import Variable as Variable, open_grid as open_grid
