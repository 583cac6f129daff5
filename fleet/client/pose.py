"""Makes the message of a pose that a program has measured from outside the car. Pure."""

import math
from typing import Any, Final

from schemas.gen import fleet_v1_pb2
from schemas.topics import TOPICS

MAX_FRAME_LENGTH: Final = 64
"""Maximum length of the name of a frame."""
_RANGES: Final = TOPICS["sensor/pose"].ranges


def pose_message(
    x_m: float, y_m: float, heading_rad: float, frame: str, xy_std_m: float | None, heading_std_rad: float | None
) -> Any:
    """Return a fleet.v1.Pose, with the heading between -pi and pi. Raises ValueError."""
    for name, value in {"x_m": x_m, "y_m": y_m}.items():
        low, high = _RANGES[name]
        if not low <= value <= high:  # this also rejects NaN
            raise ValueError(f"{name} {value:g} is not allowed: {low:g} to {high:g} m from the origin of the frame")
    if not math.isfinite(heading_rad):
        raise ValueError(f"heading_rad {heading_rad:g} is not allowed: it is the direction of the car, rad")
    for name, std in {"xy_std_m": xy_std_m, "heading_std_rad": heading_std_rad}.items():
        if std is not None and not (math.isfinite(std) and std >= 0):
            raise ValueError(
                f"{name} {std:g} is not allowed: a standard deviation is 0 or more; leave out what is unknown"
            )
    if not 0 < len(frame) <= MAX_FRAME_LENGTH or not frame.isprintable():
        raise ValueError(f"frame {frame!r} is not allowed: 1 to {MAX_FRAME_LENGTH} letters, such as map or red/odom")
    heading = math.remainder(heading_rad, math.tau)
    return fleet_v1_pb2.Pose(
        frame=frame, x_m=x_m, y_m=y_m, heading_rad=heading, xy_std_m=xy_std_m, heading_std_rad=heading_std_rad
    )
