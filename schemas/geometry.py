"""Plane geometry of simulated worlds: points, segments, boxes, circles, rays. Pure.

REP-103: meters, x forward, y left, angles counter-clockwise.
"""

from collections.abc import Iterable
from math import cos, hypot, radians, sin, sqrt
from typing import Final, TypeAlias

Point: TypeAlias = tuple[float, float]
Segment: TypeAlias = tuple[float, float, float, float]
Hit: TypeAlias = tuple[float, float]
"""The distance along a ray, and the cosine of the angle to the normal of the surface."""

RADIUS_M: Final = 0.13
"""Radius of a simulated car, which is a disc for walls, things, other cars and their sensors."""
_PARALLEL: Final = 1e-12


def box(x: float, y: float, width: float, depth: float) -> tuple[Segment, ...]:
    """Return the four sides of a rectangle around a point, `width` along x."""
    w, d = width / 2, depth / 2
    return _sides([(x - w, y - d), (x + w, y - d), (x + w, y + d), (x - w, y + d)])


def turned_box(x: float, y: float, heading: float, width: float, depth: float) -> tuple[Segment, ...]:
    """Return the four sides of a rectangle turned by `heading` rad."""
    c, s, w, d = cos(heading), sin(heading), width / 2, depth / 2
    corners = ((-w, -d), (w, -d), (w, d), (-w, d))
    return _sides([(x + ahead * c - left * s, y + ahead * s + left * c) for ahead, left in corners])


def in_turned_box(x: float, y: float, heading: float, width: float, depth: float) -> bool:
    """Return True if a point, as seen from the middle of a rectangle turned by `heading` rad, is in it."""
    c, s = cos(heading), sin(heading)
    return abs(x * c + y * s) < width / 2 and abs(y * c - x * s) < depth / 2


def _sides(corners: list[Point]) -> tuple[Segment, ...]:
    return tuple((*a, *b) for a, b in zip(corners, (*corners[1:], corners[0]), strict=True))


def loop(half_x: float, half_y: float, radius: float) -> list[Point]:
    """Return a rectangle with round corners, counter-clockwise, from the middle of its lower side."""
    points: list[Point] = [(0.0, -half_y)]
    corners = ((1, -1, -90), (1, 1, 0), (-1, 1, 90), (-1, -1, 180))
    for sx, sy, start in corners:
        cx, cy = sx * (half_x - radius), sy * (half_y - radius)
        for part in range(13):
            angle = radians(start + 90 * part / 12)
            points.append((cx + radius * cos(angle), cy + radius * sin(angle)))
    return points


def reach(segment: Segment, away: float) -> Segment:
    """Return the bounds of all points within `away` of a segment: low x, low y, high x, high y."""
    x1, y1, x2, y2 = segment
    return min(x1, x2) - away, min(y1, y2) - away, max(x1, x2) + away, max(y1, y2) + away


def foot(x: float, y: float, segment: Segment) -> Point:
    """Return the nearest point of a segment."""
    x1, y1, x2, y2 = segment
    wx, wy = x2 - x1, y2 - y1
    square = wx * wx + wy * wy
    if square == 0:  # 0 also for lengths whose square underflows, such as 1e-200
        return x1, y1
    share = min(1.0, max(0.0, ((x - x1) * wx + (y - y1) * wy) / square))
    return x1 + share * wx, y1 + share * wy


def distance(x: float, y: float, segment: Segment) -> float:
    """Return the distance from a point to a segment."""
    fx, fy = foot(x, y, segment)
    return hypot(x - fx, y - fy)


def apart(a: Segment, b: Segment) -> float:
    """Return the distance between two segments, or 0 if they cross."""
    if _cross(a, b):
        return 0.0
    ends = (distance(*a[:2], b), distance(*a[2:], b), distance(*b[:2], a), distance(*b[2:], a))
    return min(ends)


def _cross(a: Segment, b: Segment) -> bool:
    def side(line: Segment, x: float, y: float) -> float:
        return (line[2] - line[0]) * (y - line[1]) - (line[3] - line[1]) * (x - line[0])

    # Touching ends have a distance of 0 anyway.
    return side(a, *b[:2]) * side(a, *b[2:]) < 0 and side(b, *a[:2]) * side(b, *a[2:]) < 0


def ray_to_segment(x: float, y: float, dx: float, dy: float, segment: Segment) -> Hit | None:
    """Return the hit of a ray on a segment. The direction of the ray has length 1."""
    x1, y1, x2, y2 = segment
    wx, wy = x2 - x1, y2 - y1
    cross = dx * wy - dy * wx
    if abs(cross) < _PARALLEL:
        return None
    along = ((x1 - x) * wy - (y1 - y) * wx) / cross
    share = ((x1 - x) * dy - (y1 - y) * dx) / cross
    return (along, abs(cross) / hypot(wx, wy)) if along >= 0 and 0 <= share <= 1 else None


def ray_to_circle(x: float, y: float, dx: float, dy: float, middle: Point, radius: float) -> Hit | None:
    """Return the hit of a ray on a circle; distance 0 from inside. The direction of the ray has length 1."""
    mx, my = middle[0] - x, middle[1] - y
    outside = mx * mx + my * my - radius * radius
    if outside <= 0:
        return (0.0, 1.0)
    ahead = mx * dx + my * dy
    inner = ahead * ahead - outside
    if ahead <= 0 or inner < 0:
        return None
    return (ahead - sqrt(inner), sqrt(inner) / radius)


def nearest(hits: Iterable[Hit | None]) -> Hit | None:
    """Return the first of several hits."""
    return min((hit for hit in hits if hit is not None), default=None)
