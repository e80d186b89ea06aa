"""YAML from files that anybody may have written: plain values only, and no more of them than a person writes.

``yaml.SafeLoader`` runs no code, but lets a few lines stand for billions of values by aliases of aliases, and
nests as deep as Python's stack.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

import yaml
from yaml.nodes import MappingNode, Node, ScalarNode, SequenceNode

LARGEST_TEXT = 4 << 20
"""Bytes of a file."""
MOST_VALUES = 200_000
"""In a file, each counted as often as aliases repeat it."""
DEEPEST = 40
"""Lists and maps within each other."""


def load(text: str) -> Any:
    """Return the value of a YAML text. Raises ``yaml.YAMLError``, also for one beyond the limits."""
    loader = _Loader(text)
    try:
        node = loader.get_single_node()
        return None if node is None else loader.construct_document(node)
    except RecursionError:
        raise yaml.YAMLError("nested too deeply") from None
    except ValueError as error:  # a date that no calendar has, or a number too long to read
        raise _problem(f"a value cannot be read ({error})", None) from error
    finally:
        loader.dispose()


def replaced(text: str, place: Sequence[str | int], value: str) -> str:
    """Return the text with another value at a place, such as ``("links", 0, "url")``; comments and all else
    stay.

    Raises ``KeyError`` where nothing stands there, and ``yaml.YAMLError``.
    """
    node = yaml.compose(text, yaml.SafeLoader)
    for step in place:
        if isinstance(node, MappingNode):
            node = {key.value: kept for key, kept in node.value}[step]
        elif isinstance(node, SequenceNode) and isinstance(step, int) and step < len(node.value):
            node = node.value[step]
        else:
            raise KeyError(step)
    if not isinstance(node, ScalarNode):
        raise KeyError(place[-1])
    # JSON's text in quotes is YAML as well, whatever characters it has.
    return text[: node.start_mark.index] + json.dumps(value) + text[node.end_mark.index :]


class _Loader(yaml.SafeLoader):
    """Counts while it composes."""

    def __init__(self, text: str) -> None:
        super().__init__(text)
        self._depth = 0
        self._sizes: dict[int, int] = {}  # by the identity of a node

    def compose_node(self, parent: Node | None, index: Any) -> Node | None:
        """Return the library's, held to the bounds on depth and size; aliases count as often as they are
        used."""
        self._depth += 1
        if self._depth > DEEPEST:
            raise _problem(f"lists and maps are nested more than {DEEPEST} deep", self.peek_event())  # type: ignore[no-untyped-call]
        is_alias = self.check_event(yaml.AliasEvent)
        node: Node | None = super().compose_node(parent, index)
        if is_alias and id(node) not in self._sizes:
            raise _problem("an alias stands inside what it names", node)
        self._depth -= 1
        if node is not None and id(node) not in self._sizes:
            self._sizes[id(node)] = self._size(node)
            if self._sizes[id(node)] > MOST_VALUES:
                raise _problem(f"more than {MOST_VALUES} values, aliases counted as often as used", node)
        return node

    def _size(self, node: Node) -> int:
        children: list[Node] = []
        if isinstance(node, SequenceNode):
            children = node.value
        elif isinstance(node, MappingNode):
            _refuse_repeated(node)
            children = [each for pair in node.value for each in pair]
        elif not isinstance(node, ScalarNode):
            raise _problem("no plain value", node)
        return 1 + sum(self._sizes[id(child)] for child in children)


def _refuse_repeated(node: MappingNode) -> None:
    """Refuse a name that stands twice in one map: the latter alone would count, in silence."""
    lines: dict[str, int] = {}
    for key, _ in node.value:
        if not isinstance(key, ScalarNode) or key.tag == "tag:yaml.org,2002:merge":
            continue
        name, line = f"{key.tag} {key.value}", key.start_mark.line + 1
        if name in lines:
            raise _problem(f"'{key.value[:80]}' stands here and in line {lines[name]}: leave one out", key)
        lines[name] = line


def _problem(text: str, at: Any) -> yaml.MarkedYAMLError:
    return yaml.MarkedYAMLError(problem=text, problem_mark=getattr(at, "start_mark", None))
