"""Read every car: the latest values, then 20 readings.

`python -m fleet.examples.programs.read_all`
"""

from itertools import islice

from fleet import Fleet


def main() -> None:
    """Print readings. A field that was not measured is None."""
    with Fleet() as fleet:
        print("cars:", ", ".join(fleet.cars()))
        for reading in fleet.get("*/sensor/battery"):
            print(f"{reading.car}: {reading['voltage_v']:.2f} V, {reading.age_s():.1f} s ago")
        for reading in islice(fleet.watch("*/sensor/range"), 20):
            measured = reading["range_m"]
            print(f"{reading.car}:", "no echo" if measured is None else f"{measured:.2f} m")


if __name__ == "__main__":
    main()
