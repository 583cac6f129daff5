"""Plot the distances of a session.

`python -m fleet.examples.programs.distance_over_time latest red distance.png`
"""

import sys

from fleet import Session


def main(session: str, car: str, picture: str) -> None:
    """Save the picture. Each dot is a reading. A reading without an echo has no dot."""
    frame = Session(session).to_pandas(f"{car}/sensor/range")
    # The time zone of this computer, with its offset at that time.
    zone = frame["publish_time"].min().floor("s").to_pydatetime().astimezone().tzinfo
    frame["time"] = frame["publish_time"].dt.tz_convert(zone)
    plot = frame.plot(x="time", y="range_m", style=".", xlabel=f"time ({zone})", ylabel="distance (m)")
    plot.figure.savefig(picture)


if __name__ == "__main__":
    main(*sys.argv[1:])
