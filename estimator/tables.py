"""A result on the screen."""

from rich.console import Console
from rich.table import Table

from .result import Result


def result_tables(result: Result, console: Console) -> None:
    """Points, boards, distances, consistency and what the user has to know."""
    if result.points:
        console.print(points_table(result))
    if result.distances:
        console.print(_distances(result))
    console.print(_families(result))
    verdict = "consistent with its own data" if result.consistency.passed else "NOT CONSISTENT with its own data"
    console.print(f"The estimate is {verdict}.", style=None if result.consistency.passed else "bold red")
    for reason in result.consistency.reasons:
        console.print(f"  - {reason}", highlight=False)
    for event in result.events:
        if event.severity != "info":
            console.print(f"{event.severity}: {event.text}", highlight=False)
    if result.rejected:
        counts: dict[str, int] = {}
        for r in result.rejected:
            counts[r.family] = counts.get(r.family, 0) + 1
        told = ", ".join(f"{family} {count}" for family, count in sorted(counts.items()))
        console.print(f"Rejected measurements (kept in the result with their reasons): {told}.", highlight=False)


def points_table(result: Result) -> Table:
    """Pipe points in {b}, millimetres."""
    table = Table(title="Pipe points in {b}")
    for name in ("point", "role", "x mm", "y mm", "z mm", "95 % radius mm", "picks"):
        table.add_column(name, justify="left" if name in ("point", "role") else "right")
    for p in result.points:
        x, y, z = (f"{1e3 * v:.1f}" for v in p.position_m)
        table.add_row(p.id, p.role, x, y, z, f"{1e3 * p.radius95_m:.1f}", str(p.measurements))
    return table


def _distances(result: Result) -> Table:
    table = Table(title="Distances between marker points")
    for name in ("points", "estimate mm", "sigma mm", "given mm", "difference mm"):
        table.add_column(name, justify="left" if name == "points" else "right")
    for d in result.distances:
        given = "" if d.given_m is None else f"{1e3 * d.given_m:.1f}"
        off = "" if d.given_m is None else f"{1e3 * (d.distance_m - d.given_m):+.1f}"
        table.add_row(d.name, f"{1e3 * d.distance_m:.1f}", f"{1e3 * d.sigma_m:.2f}", given, off)
    return table


def _families(result: Result) -> Table:
    table = Table(title="Factor families")
    for name in ("family", "factors", "chi2/dof", "limit"):
        table.add_column(name, justify="left" if name == "family" else "right")
    for f in result.consistency.by_family:
        ratio = f"{f.chi2 / f.dof:.2f}" if f.dof >= 1 else "-"
        limit = f"{f.upper:.2f}" if f.dof >= 1 else "-"
        table.add_row(f.family, str(f.residuals), ratio, limit)
    return table
