# SPDX-License-Identifier: Apache-2.0
"""The figures as Markdown, ready for docs/performance.md."""

from collections.abc import Iterable, Sequence

from benchmarks.case import Figures

__all__ = ["report", "table"]

_BUSY = 1.05  # wall clock over processor time from which on somebody else used the core


def report(machine: Sequence[tuple[str, str]], figures: Sequence[Figures]) -> str:
    """All tables.

    Args:
        machine: label and value, see `machine.describe`.
        figures: one a case, in the order wanted.
    """
    return "\n".join(
        [
            *table(("", ""), machine),
            "",
            *_speed(figures),
            "",
            _linearity(figures),
            "",
            *_stages(figures),
            "",
            *_roofline(figures),
            "",
            *_beside(figures),
            *_warnings(figures),
        ]
    )


def table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """Markdown lines; all columns but the first are right-aligned where there are several."""
    align = ["---", *(["---:"] * (len(header) - 1) if len(header) > 2 else ["---"])]
    return [f"| {' | '.join(cells)} |" for cells in (header, align, *rows)]


def _speed(figures: Sequence[Figures]) -> list[str]:
    rows = [
        (
            each.case.name,
            f"{each.points_out:,}",
            f"{each.seconds:.2f} s",
            f"{each.slowest:.2f} s",
            f"{each.cpu_seconds:.2f} s",
            f"{each.rate:,.0f}",
            f"{each.peak_bytes / 2**20:,.0f} MiB",
            f"{(each.peak_bytes - each.base_bytes) / 2**20:,.0f} MiB",
        )
        for each in figures
    ]
    header = (
        "input",
        "points out",
        "fastest run",
        "slowest run",
        "processor time",
        "points out a second of it",
        "peak memory",
        "of which for this cloud",
    )
    return table(header, rows)


def _linearity(figures: Sequence[Figures]) -> str:
    same = [each for each in figures if each.case.ratio == figures[0].case.ratio]
    small = min(same, key=lambda each: each.case.points)
    large = max(same, key=lambda each: each.case.points)
    return (
        f"Linearity: the rate at {large.case.points:,} points is "
        f"{large.rate / small.rate:.2f} times the rate at {small.case.points:,}."
    )


def _stages(figures: Sequence[Figures]) -> list[str]:
    names = list(figures[0].stages)
    rows = [
        (
            each.case.name,
            *(f"{100 * each.stages.get(name, 0.0) / each.cpu_seconds:.1f} %" for name in names),
        )
        for each in figures
    ]
    return table(("share of the processor time", *names), rows)


def _roofline(figures: Sequence[Figures]) -> list[str]:
    kind = figures[0].work.kind
    rows = [
        (
            each.case.name,
            f"{each.work.flops / 1e6:.2f}",
            f"{each.gflops[each.work.kind]:.0f}",
            f"{1e6 * each.work.seconds(each.gflops):.1f} µs",
            f"{1e6 * each.network_seconds:.1f} µs",
            f"{100 * each.roofline:.0f} %",
            f"{each.work.bytes / 1e3:.0f} kB",
            f"{each.work.bytes / each.network_seconds / 1e9:.1f}",
        )
        for each in figures
    ]
    header = (
        "the network, a chart",
        "MFLOP of its products",
        f"{kind} GFLOP/s in the same run",
        "time at that rate",
        "time of the stage",
        "share of the rate",
        "its tensors, read and written",
        "GB/s of them",
    )
    return table(header, rows)


def _beside(figures: Sequence[Figures]) -> list[str]:
    types = list(figures[0].gflops)
    rows = []
    for each in figures:
        ours, theirs = each.accuracy, each.rival_accuracy
        rows.append(
            (
                each.case.name,
                *(f"{each.gflops[name]:.0f}" for name in types),
                f"{each.rate / each.gflops[types[0]]:.0f}",
                f"{each.rival_rate:,.0f}",
                f"{each.rate / each.rival_rate:.2f}",
                f"{ours.distance:.3f} / {theirs.distance:.3f}",
                f"{ours.angle:.2f} / {theirs.angle:.2f}",
                f"{ours.evenness:.3f} / {theirs.evenness:.3f}",
            )
        )
    header = (
        "beside it in the same run",
        *(f"{name} GFLOP/s" for name in types),
        f"points per {types[0]} GFLOP",
        "rival, points a second",
        "our rate / rival's",
        "distance ours / rival's (% of spacing)",
        "normals ours / rival's (degrees)",
        "evenness ours / rival's",
    )
    return table(header, rows)


def _warnings(figures: Sequence[Figures]) -> list[str]:
    busy = [each for each in figures if each.seconds > _BUSY * each.cpu_seconds]
    if not busy:
        return []
    worst = max(each.seconds / each.cpu_seconds for each in busy)
    names = ", ".join(each.case.name for each in busy)
    warning = (
        f"The core was shared while these ran: {names}. Their wall clock is up to "
        f"{100 * (worst - 1):.0f} % above their processor time."
    )
    return ["", warning]
