"""What is left of a document's values without the faulty ones, and where in the text each of them stands. Pure."""

from collections.abc import Collection, Mapping
from typing import Any

from schemas.yaml_document.messages import Where


class PartialTree:
    """A tree of plain data without some places, and with others added: what `marked` looks at for more faults."""

    def __init__(self, tree: Any, dropped: Collection[Where] = (), added: Mapping[Where, object] | None = None) -> None:
        self._kept: dict[Where, list[int]] = {}
        self._dropped, self._added = dropped, added or {}
        self.tree = self._left((), tree) if dropped or added else tree

    def original(self, where: Where) -> Where:
        """The place in the whole tree of a place in this one."""
        found: Where = ()
        for part in where:
            kept = self._kept.get(found)
            found = (*found, kept[part] if kept is not None and isinstance(part, int) else part)
        return found

    def _left(self, where: Where, value: Any) -> Any:
        if isinstance(value, dict):
            left = {name: self._left((*where, name), each) for name, each in value.items() if self._is((*where, name))}
            return left | {str(at[-1]): each for at, each in self._added.items() if at[:-1] == where}
        if isinstance(value, list):
            kept = self._kept[where] = [index for index in range(len(value)) if self._is((*where, index))]
            return [self._left((*where, index), value[index]) for index in kept]
        return value

    def _is(self, where: Where) -> bool:
        return where not in self._dropped
