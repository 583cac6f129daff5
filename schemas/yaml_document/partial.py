"""The valid values of a document, with their places in the whole document. Pure."""

from collections.abc import Collection, Mapping
from typing import Any

from schemas.yaml_document.fault_words import Where


class PartialTree:
    """A copy of plain data without some places and with others added. document.py looks for more faults in it."""

    def __init__(self, tree: Any, dropped: Collection[Where] = (), added: Mapping[Where, object] | None = None) -> None:
        self._indices: dict[Where, list[int]] = {}
        self._dropped, self._added = dropped, added or {}
        self.tree = self._copy((), tree) if dropped or added else tree

    def original(self, where: Where) -> Where:
        """Translate a place of this tree to its place in the whole tree."""
        place: Where = ()
        for part in where:
            indices = self._indices.get(place)
            place = (*place, indices[part] if indices is not None and isinstance(part, int) else part)
        return place

    def _copy(self, where: Where, value: Any) -> Any:
        if isinstance(value, dict):
            copy = {
                name: self._copy((*where, name), each) for name, each in value.items() if self._stays((*where, name))
            }
            return copy | {str(at[-1]): each for at, each in self._added.items() if at[:-1] == where}
        if isinstance(value, list):
            indices = self._indices[where] = [index for index in range(len(value)) if self._stays((*where, index))]
            return [self._copy((*where, index), value[index]) for index in indices]
        return value

    def _stays(self, where: Where) -> bool:
        return where not in self._dropped
