"""What people read: the rows of a file of results as tables in Markdown.

Axis letters: P population member.
"""

from collections.abc import Callable, Sequence
from typing import Any

NO_FIGURE = "–"


def number(value: float | None) -> str:
    """Three digits, with commas."""
    if value is None:
        return NO_FIGURE
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"


def size(count: float) -> str:
    """Bytes in words."""
    return f"{count / 2**30:.1f} GiB" if count >= 2**30 else f"{count / 2**20:.0f} MiB"


def percent(share: float | None) -> str:
    """A share in words."""
    return NO_FIGURE if share is None else f"{100 * share:.2g} %"


def at_once(mapped: str, without_memory: Sequence[str]) -> str:
    """How members were mapped, and how they were not for want of memory."""
    return f"{mapped} (no memory for {', '.join(without_memory)})" if without_memory else mapped


def table(values: dict[str, Any]) -> str:
    """All tables, and above them what they are of.

    Args:
      values: of a file of results, see `results.Results`.
    """
    lines = [*_head(values), ""]
    for title, chosen, columns in _TABLES:
        rows = [row for row in values["rows"] if chosen(row["part"])]
        if rows:
            lines += [f"**{title}**", "", *_lines(rows, columns), ""]
    lines += _learning([row for row in values["rows"] if row["part"] == "learning"])
    return "\n".join(lines).rstrip() + "\n"


def _head(values: dict[str, Any]) -> list[str]:
    machine, peaks = values["machine"], values["peak_tflops"]
    if machine is None:
        return [f"{values['date']}, sizes `{values['sizes']}`: nothing was measured."]
    bound = "its peak is not known (--peak-tflops)"
    if peaks is not None:
        bound = f"its peak taken as {peaks[0]:g} TFLOP/s in float32 and {peaks[1]:g} in bfloat16"
    cached = ", compiled programs from a cache on the disk" if machine["compilation_cache"] else ""
    flags = f", `XLA_FLAGS={machine['xla_flags']}`" if machine["xla_flags"] else ""
    revisions = sorted({row["revision"] for row in values["rows"] if "figures" in row})
    return [
        f"{values['date']}, sizes `{values['sizes']}`, one of {machine['devices']} "
        f"`{machine['card']}` with {size(machine['memory_bytes'])} for JAX, {bound}; "
        f"cores {machine['cores']}, Python {machine['python']}, jax {machine['jax']}, products of "
        f"float32 `{machine['matmul_precision']}`{flags}{cached}, revision {', '.join(revisions)}."
    ]


Column = tuple[str, Callable[[dict[str, Any]], str]]


def _lines(rows: Sequence[dict[str, Any]], columns: Sequence[Column]) -> list[str]:
    """A table; what has no figures says why in the place of the first."""
    names = ["what", *(name for name, _ in columns)]
    found = [f"| {' | '.join(names)} |", "|" + "---|" * len(names)]
    for row in rows:
        cells = [f"{row['part']}, {row['case']}"]
        if "figures" in row:
            cells += [shown(row["figures"]) for _, shown in columns]
        else:
            kind = "skipped" if "skipped" in row else "failure"
            cells += [f"{kind}: {plain(row[kind])}", *[""] * (len(columns) - 1)]
        found.append(f"| {' | '.join(cells)} |")
    return found


def plain(words: str) -> str:
    """Words that break no table."""
    return " ".join(words.replace("|", "/").split())


def _learning(rows: Sequence[dict[str, Any]]) -> list[str]:
    found = []
    for row in rows:
        if "figures" not in row:
            found += ["**Learning**", "", *_lines(rows, (("", str),)), ""]
            continue
        figures = row["figures"]
        seeds = ", ".join(map(str, figures["seeds"]))
        found += [
            f"**Learning** ({figures['task']}, preset `{figures['preset']}`, seeds {seeds}; "
            f"{number(figures['seconds'])} s of training, {figures['env_steps']:,} environment "
            f"steps, {figures['updates']:,} updates, ended {figures['ended']})",
            "",
            "| environment steps | updates | seconds | returns |",
            "|---|---|---|---|",
        ]
        for one in figures["evaluations"]:
            returns = ", ".join(number(x) for x in one["returns"])
            found.append(
                f"| {one['env_steps']:,} | {one['updates']:,} | {number(one.get('seconds'))} "
                f"| {returns} |"
            )
    return found


_TABLES: tuple[tuple[str, Callable[[str], bool], tuple[Column, ...]], ...] = (
    (
        "Updates",
        lambda part: part.startswith("update"),
        (
            ("member updates a second", lambda x: number(x["member_updates_per_second"])),
            ("members at once", lambda x: at_once(x["mapped"], x["without_memory"])),
            ("share of the peak", lambda x: percent(x["share_of_peak"])),
            ("compiled in, s", lambda x: number(x["compile_seconds"])),
            ("most memory so far", lambda x: size(x["peak_bytes"])),
        ),
    ),
    (
        "One update beside PyTorch, in turns",
        lambda part: part == "peer",
        (
            ("ours, s", lambda x: number(x["seconds_per_update"])),
            ("PyTorch, s", lambda x: number(x["peer_seconds_per_update"])),
            ("ratio", lambda x: number(x["ratio"])),
            ("PyTorch's version", lambda x: f"{x['torch']} on {x['peer_on']}"),
        ),
    ),
    (
        "Rollouts in the graph",
        lambda part: part == "rollout",
        (
            ("agent steps a second", lambda x: number(x["agent_steps_per_second"])),
            ("task", lambda x: x["task"]),
            ("compiled in, s", lambda x: number(x["compile_seconds"])),
            ("most memory so far", lambda x: size(x["peak_bytes"])),
        ),
    ),
    (
        "A round of one agent",
        lambda part: part == "round",
        (
            ("a round, s", lambda x: number(x["seconds_per_round"])),
            ("of agent steps", lambda x: number(x["agent_steps"])),
            ("and updates", lambda x: number(x["updates"])),
            ("the first, s", lambda x: number(x["first_round_seconds"])),
            ("most memory so far", lambda x: size(x["peak_bytes"])),
        ),
    ),
)
