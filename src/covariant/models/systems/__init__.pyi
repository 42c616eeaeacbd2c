from ._ball_and_beam import ball_and_beam as ball_and_beam
from ._duffing import duffing as duffing
from ._heavy_top import free_body as free_body, heavy_top as heavy_top
from ._hopping_leg import hopping_leg as hopping_leg
from ._hovercraft import hovercraft as hovercraft
from ._lorenz import lorenz as lorenz
from ._oscillator import oscillator as oscillator
from ._pendulum_chain import pendulum_chain as pendulum_chain
from ._satellite import satellite as satellite
from ._underwater_vehicle import underwater_vehicle as underwater_vehicle
from ._unknown_frequency import unknown_frequency as unknown_frequency
