"""The fields of a world file. `world_check` checks how the fields fit together. Pure."""

from typing import Annotated, Any, Final

from pydantic import AfterValidator, Field

from schemas.keys import check_name
from schemas.yaml_document.document import Entry

_MAX_ITEMS: Final = 200

_Place = Annotated[float, Field(ge=-100, le=100)]
_Size = Annotated[float, Field(ge=0.02, le=100)]
_Degrees = Annotated[float, Field(ge=-360, le=360)]
_Point = tuple[_Place, _Place]
_Wall = tuple[_Place, _Place, _Place, _Place]
_Name = Annotated[
    str,
    AfterValidator(lambda name: check_name(name, "name")),
    Field(json_schema_extra={"pattern": "^[a-z0-9][a-z0-9_-]{0,31}$"}),
]


class RoomEntry(Entry):
    """Four walls around (0, 0)."""

    width_m: _Size = Field(description="its size along x, meters")
    depth_m: _Size = Field(description="its size along y, meters")


class BoxEntry(Entry):
    """A solid box that does not move."""

    x_m: _Place = Field(description="its middle, meters to the right of (0, 0)")
    y_m: _Place = Field(description="its middle, meters up from (0, 0)")
    width_m: _Size = Field(description="its size along x, meters")
    depth_m: _Size = Field(description="its size along y, meters")


class LineEntry(Entry):
    """A line on the floor: a rectangle with round corners, around (0, 0)."""

    width_m: _Size = Field(description="its size along x, meters")
    depth_m: _Size = Field(description="its size along y, meters")
    radius_m: _Size = Field(description="the radius of its corners, meters: at most half of the shorter side")


class StartEntry(Entry):
    """Where a car begins."""

    x_m: _Place = Field(description="meters to the right of (0, 0)")
    y_m: _Place = Field(description="meters up from (0, 0)")
    heading_deg: _Degrees = Field(default=0.0, description="its direction, degrees counter-clockwise from x")


def _coordinate(unless: str, offset: str) -> Any:
    """Return a coordinate of a thing or a lamp.

    `unless` says when it may be left out, `offset` what it means if the thing or lamp is carried.
    """
    words = f"where it stands, meters, required unless {unless}; if carried, how far {offset}"
    return Field(default=0.0, description=words)


class ThingEntry(Entry):
    """A disc or a box that stands, moves along a path, or is carried by a car."""

    # If the default of a field has no meaning, the field has a default factory, so that editors show no default.
    # `world_check` reports fields that are missing or not allowed.
    x_m: _Place = _coordinate("it has a path or is carried", "ahead of the car's middle")
    y_m: _Place = _coordinate("it has a path or is carried", "to the left of the car's middle")
    heading_deg: _Degrees = Field(default=0.0, description="its direction, degrees counter-clockwise from x")
    radius_m: _Size = Field(default_factory=float, description="radius of a disc, meters")
    width_m: _Size = Field(default_factory=float, description="width of a box, meters, instead of `radius_m`")
    depth_m: _Size = Field(default_factory=float, description="depth of a box, meters, with `width_m`")
    path: list[_Point] = Field(
        default_factory=list,
        min_length=2,
        max_length=_MAX_ITEMS,
        description="the points [x, y] of its path; after the last one it moves straight back to the first, unless "
        "`there_and_back` is true",
    )
    there_and_back: bool = Field(
        default=False, description="true: from the last point of its path it goes back the same way"
    )
    speed_m_s: float = Field(default=0.0, ge=0, le=0.5, description="its speed along the path, m/s")
    waits_for_m: float = Field(
        default_factory=float, ge=0, le=100, description="it moves only while a car is within this distance, meters"
    )
    carried_by: _Name = Field(default_factory=str, description="the car that it moves with")


class LampEntry(Entry):
    """A lamp that the light sensors see, if nothing is in between."""

    x_m: _Place = _coordinate("it is carried", "ahead of its carrier's middle")
    y_m: _Place = _coordinate("it is carried", "to the left of its carrier's middle")
    reach_m: float = Field(
        default=1.5, gt=0, le=100, description="distance from which a lamp of brightness 1 is seen, meters"
    )
    brightness: float = Field(
        default=1.0, ge=0, le=100, description="how bright it is: with 4, it is seen from twice as far as with 1"
    )
    on: bool = Field(default=True, description="true: it is lit")
    overhead: bool = Field(default=False, description="true: nothing blocks its light")
    carried_by: _Name = Field(default_factory=str, description="the thing or car that it moves with")


class WorldEntry(Entry):
    """Where simulated cars drive, in meters, m/s, and degrees counter-clockwise from x. Its middle is (0, 0)."""

    room: RoomEntry = Field(
        default_factory=RoomEntry.model_construct, description="four walls around (0, 0); left out: no walls"
    )
    walls: list[_Wall] = Field(
        default_factory=list,
        max_length=_MAX_ITEMS,
        description="single walls, each from one point to another: [x1, y1, x2, y2]",
    )
    boxes: list[BoxEntry] = Field(default_factory=list, max_length=_MAX_ITEMS, description="boxes that do not move")
    line: Annotated[list[_Point], Field(min_length=3, max_length=_MAX_ITEMS)] | LineEntry = Field(
        default_factory=list,
        description="the line on the floor: the points of a closed loop, or a rectangle with round corners",
    )
    cars_meet: bool = Field(default=True, description="true: cars see each other, and bump into each other")
    cars: dict[_Name, StartEntry] = Field(
        default_factory=dict,
        max_length=_MAX_ITEMS,
        description="where each car begins; a car that is not listed begins on the line, if there is one",
    )
    lamps: dict[_Name, LampEntry] = Field(
        default_factory=dict, max_length=_MAX_ITEMS, description="lamps that light sensors see"
    )
    things: dict[_Name, ThingEntry] = Field(
        default_factory=dict,
        max_length=_MAX_ITEMS,
        description="discs and boxes that cars see, bump into and follow; they may move",
    )
