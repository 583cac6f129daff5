"""One process per car: its bytes become keyed Zenoh publications, commands become bytes."""
