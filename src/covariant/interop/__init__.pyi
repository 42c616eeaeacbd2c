from ._python_control import closed_loop as closed_loop, observer_system as observer_system, plant as plant
