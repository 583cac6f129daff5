"""Compares a text by the values in it: names, numbers, codes. The words between may change."""


def has_parts(text: str, parts: str) -> bool:
    """Return True if the text has these parts in their order. ` … ` stands for any words between two parts."""
    place = 0
    for part in parts.split(" … "):
        place = text.find(part, place)
        if place < 0:
            return False
        place += len(part)
    return True
