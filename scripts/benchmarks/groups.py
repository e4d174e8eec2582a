"""Tables of cases in groups, and the cases that names stand for."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from benchmarks.problem import Case
from gnrecon.runtime.errors import UsageError

Groups = Mapping[str, Mapping[str, Case]]
"""Names that stand for several cases, each with its name."""


def cases_of(groups: Groups) -> dict[str, Case]:
    """Return the cases of all groups by name, each once."""
    return {name: case for group in groups.values() for name, case in group.items()}


def chosen_cases(names: Iterable[str], groups: Groups) -> dict[str, Case]:
    """Return the cases that names of cases and of groups stand for, each once, in the order of the tables.

    Raises
    ------
    UsageError
        When a name is neither.
    """
    cases, wanted = cases_of(groups), set[str]()
    for name in names:
        if name not in groups and name not in cases:
            known = ", ".join(map(repr, cases))
            raise UsageError(f"There is no case {name!r}; the groups are {', '.join(groups)}, the cases {known}.")
        wanted |= set(groups.get(name, [name]))
    return {name: case for name, case in cases.items() if name in wanted}
