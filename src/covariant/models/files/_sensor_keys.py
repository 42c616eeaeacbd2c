"""Lists the keys of each kind of sensor in a model file; `observers.sensors` defines what each kind measures."""

from typing import NamedTuple


class SensorKeys(NamedTuple):
    """Keys in the table of one kind of sensor, in addition to the keys of every kind.

    Attributes:
        required: Keys that the table needs.
        optional: Keys that it may have.
    """

    required: tuple[str, ...]
    optional: tuple[str, ...]


EVERY_SENSOR = SensorKeys(("kind", "columns"), ("units", "delay"))
"""Keys of every kind of sensor."""
_BIAS = ("bias", "bias_drift")
SENSOR_KEYS = {
    "encoder": SensorKeys(("of", "std"), ("reduction", *_BIAS)),
    "tachometer": SensorKeys(("of", "std"), ("reduction", *_BIAS)),
    "gyro": SensorKeys(("link", "std"), ("axes", *_BIAS)),
    "accelerometer": SensorKeys(("link", "std"), ("axes", "place", "gravity", *_BIAS)),
    "pose": SensorKeys(("link", "attitude", "position_std", "rotation_std"), ("axes", "place")),
    "point": SensorKeys(("link", "std"), ("place", *_BIAS)),
}
"""The kinds of sensors of a model file, with their keys."""
