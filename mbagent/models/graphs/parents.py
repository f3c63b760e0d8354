"""What the graphs say that a variable hangs on."""

from __future__ import annotations

from mbagent.models.fit_report import Variable
from mbagent.models.graphs.compiled import Graphs
from mbagent.models.graphs.units import Layout


def asked_columns(graphs: Graphs, unit: int) -> set[int]:
    """Columns that the graphs of a unit ask for."""
    if unit not in graphs.changing:
        return set()
    begin, end = graphs.entries[graphs.pairs[unit]], graphs.entries[graphs.pairs[unit + 1]]
    stack, seen = [int(node) for node in graphs.nodes[begin:end]], set()
    while stack:
        node = stack.pop()
        if node not in seen:
            seen.add(node)
            if graphs.column[node] >= 0:
                stack += [int(graphs.off[node]), int(graphs.on[node])]
    return {int(graphs.column[node]) for node in seen if graphs.column[node] >= 0}


def hangs_on_action(graphs: Graphs, unit: int, layout: Layout) -> bool:
    """Whether what a unit does differs from action to action."""
    n, first = int(layout.outputs[unit]), int(graphs.pairs[unit])

    def ways(pair: int) -> list[tuple[int, int]]:
        entries = range(graphs.entries[first + pair], graphs.entries[first + pair + 1])
        return [(int(graphs.values[e]), int(graphs.nodes[e])) for e in entries]

    return any(ways(way * n + value) != ways(value) for value in range(n) for way in range(1, layout.acts.n_ways))


def parent_factors(layout: Layout, columns: set[int]) -> set[int]:
    """Factors that state columns are about; those of the next state are left out."""
    return {int(layout.factor[column]) for column in columns if column < len(layout.factor)}


def flat_variables(layout: Layout, graphs: Graphs, late: Graphs) -> list[Variable]:
    """Factors and groups that have graphs, and what they hang on besides themselves."""
    n, after, found = len(layout.factor), len(layout.factor) + layout.acts.n_columns, []
    for unit in graphs.changing[graphs.changing < len(layout.outputs) - 2]:
        factors = tuple(int(f) for f in layout.members[layout.first[unit] : layout.first[unit + 1]])
        name = f"factor {factors[0]}" if len(factors) == 1 else f"factors {factors[0]}, {factors[1]}, …"
        columns = asked_columns(graphs, int(unit)) | asked_columns(late, int(unit))
        parents = [f"factor {f}" for f in sorted(parent_factors(layout, columns) - set(factors))]
        if hangs_on_action(graphs, int(unit), layout) or any(n <= column < after for column in columns):
            parents.insert(0, "action")
        later = {int(layout.factor[column - after]) for column in columns if column >= after}
        found.append(Variable(name, factors, (*parents, *(f"next factor {f}" for f in sorted(later)))))
    return found
