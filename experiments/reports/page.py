"""The report of a preset's results as one HTML page that needs no other file.

It answers first what the transfers did, and shows tables and curves after that. Pictures and videos
are inside of it. It reads the results folders as they are, so it can be written at any time; what
was not run is named in one line. What the page looks like is in page.html.j2 and page.css.
"""

import base64
import functools
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jinja2

from dreamer_jax.integrity import read_sealed_json
from dreamer_jax.schema import RUN, check_shape
from envs import SimulatorError
from experiments.reports import comparison, figures
from experiments.reports.classification import read_classification
from experiments.reports.comparison import Aggregate
from experiments.reports.films import Film, films
from experiments.reports.findings import Comparison, Finding, findings, scale
from experiments.reports.folding import folded, not_run
from experiments.reports.outcomes import Outcome, Run, read_outcomes, read_runs, states
from experiments.reports.sheet import (
    STATISTICS_CAPTION,
    classification_sheet,
    interval,
    returns_sheet,
    settings_changed,
    size_note,
)
from experiments.reports.verdicts import LEAST_SEEDS
from experiments.runs.folder import CELLS, latents_folder
from experiments.runs.folder import folders as places
from experiments.thesis import grid, published
from experiments.thesis.contradictions import CONTRADICTIONS
from experiments.thesis.grid import (
    FIGURES,
    TABLES,
    TASKS,
    Backend,
    Cell,
    Figure,
    LatentTable,
    ReturnsTable,
)

LARGEST_VIDEOS = 16 * 2**20
"""Bytes of all videos together; what does not fit is left out and named."""


class Picture(NamedTuple):
    """A picture as the page shows it: its data, or why there are none."""

    name: str
    caption: str
    data: str | None
    problem: str = ""


def write_page(root: str | Path, seeds: Sequence[int], backend: Backend, path: str | Path) -> Path:
    """Writes the report as one HTML file.

    Args:
      root: the folder of results folders, named after their preset.
      seeds: of targets and baselines; the first one is the sources'.
      backend: the simulator whose results are shown.
      path: where to; its folder is made if absent.

    Returns:
      The path.
    """
    root, path = Path(root), Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    text = _template().render(**_values(root, tuple(seeds), backend))
    path.write_text(text + "\n", encoding="utf-8")
    return path


@functools.cache
def _template() -> jinja2.Template:
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
    )
    return environment.get_template("page.html.j2")


def _values(root: Path, seeds: tuple[int, ...], backend: Backend) -> dict[str, Any]:
    """What the template shows."""
    held = places(root)
    tables = [
        grid.with_compared(grid.on_backend(table, backend), held, seeds)
        for table in TABLES.values()
    ]
    pictures = [grid.on_backend(figure, backend) for figure in FIGURES.values()]
    asked = [cell for entry in (*tables, *pictures) for cell in grid.shown(entry, seeds)]
    cells = grid.closure(asked)
    # What is not comparable is said at the top, once.
    runs, outcomes, size = read_runs(root), read_outcomes(root, cells), size_note(root)
    returns = [table for table in tables if isinstance(table, ReturnsTable)]
    shown = [
        folded(table.name, returns_sheet(table, outcomes, seeds, None))
        for table in returns
        if comparison.transferred(table, outcomes, seeds)
    ]
    classified = [
        (folded(table.name, classification_sheet(table, found, None)), _latents(table, root, seeds))
        for table in tables
        if isinstance(table, LatentTable)
        and (found := read_classification(root, table, seeds)) is not None
    ]
    curves = [
        _curves(figure, outcomes, seeds)
        for figure in pictures
        if figure.kind != "tasks" and figures.begun(figure, outcomes, seeds)
    ]
    tasks = [_tasks(figure) for figure in pictures if figure.kind == "tasks"]
    together = _together(returns, outcomes, seeds)
    videos, left_out = _films(runs)
    folders, versions = _provenance(root, runs)
    state = states(outcomes.values())
    evaluations = sum(len(outcome.env_steps) for outcome in outcomes.values())
    named = {
        "tables": [one.name for one in shown],
        "ltc": [one.name for one, _ in classified],
        "curves": [one.name for one in curves],
        "tasks": [one.name for one in tasks],
    }
    sections = [
        ("tables", "Tables", shown),
        ("ltc", "Latent task classification", classified),
        ("curves", "Learning curves", curves),
        ("together", "All targets together", together),
        ("videos", "Videos", videos or left_out),
        ("tasks", "The tasks", tasks),
        ("reading", "How to read this", True),
        ("contradictions", "Contradictions of the thesis", True),
        ("provenance", "Where the numbers come from", True),
    ]
    return {
        "style": Path(__file__).with_name("page.css").read_text(encoding="utf-8"),
        "preset": root.name,
        "simulator": {"bullet": "PyBullet", "brax": "Brax"}[backend],
        "seeds": _seeds(seeds),
        "standing": (
            f"Of {len(outcomes)} agents {state['done']} are done, {state['cut']} cut, "
            f"{state['failed']} failed and {state['missing']} not begun; {evaluations:,} "
            "evaluations were made."
        ),
        "size": size and size[0].upper() + size[1:],
        "changed": settings_changed(root),
        "failed": [cell.name for cell, one in outcomes.items() if one.state == "failed"],
        "findings": [_finding(one) for one in findings(returns, outcomes, seeds)],
        "least_seeds": LEAST_SEEDS,
        "statistics_caption": STATISTICS_CAPTION,
        "contents": [
            ({"id": id, "text": text}, [(x, x.replace("-", " ")) for x in named.get(id, ())])
            for id, text, there in sections
            if there
        ],
        "tables": shown,
        "classification": classified,
        "curves": curves,
        "not_run": not_run(
            one.name
            for one in (*tables, *pictures)
            if not any(one.name in names for names in named.values())
        ),
        "together": together,
        "films": videos,
        "films_left_out": left_out,
        "largest_videos": f"{LARGEST_VIDEOS / 2**20:.0f} MiB",
        "tasks": tasks,
        "contradictions": [(one.what, one.where, one.choice) for one in CONTRADICTIONS],
        "published": len(published.records()),
        "folders": folders,
        "versions": versions,
    }


def _seeds(seeds: Sequence[int]) -> str:
    return f"seed{'s' if len(seeds) != 1 else ''} {', '.join(map(str, sorted(seeds))) or 'none'}"


# --- at a glance ----------------------------------------------------------------------------------


def _finding(finding: Finding) -> dict[str, Any]:
    """A method's sentence and its forest plot, a part for each metric and target."""
    parts = [
        _forest(f"{target}, {metric} return", comparisons)
        for metric, by_target in finding.comparisons.items()
        for target, comparisons in by_target.items()
    ]
    return {"sentence": finding.sentence, "parts": parts}


def _forest(title: str, comparisons: Sequence[Comparison]) -> dict[str, Any]:
    """Rows with their places on an axis in percent of its width."""
    extent = scale(comparisons)

    def percent(value: float) -> str:
        return f"{100 * extent.place(value):.1f}"

    rows = []
    for one in comparisons:
        transfer = one.transfer
        value, low, high = transfer.difference
        rows.append(
            {
                "name": one.entry.name,
                "word": transfer.verdict or "undecided",
                "told": one.word,
                "at": percent(value),
                "left": None if low is None else percent(low),
                "right": None if high is None else f"{100 - 100 * extent.place(high):.1f}",
                "seeds": one.seeds,
                "improvement": interval(transfer.improvement, 2),
                "difference": interval(transfer.difference, sign="+"),
            }
        )
    return {
        "title": title,
        "low": f"{extent.low:+,.0f}",
        "high": f"{extent.high:+,.0f}",
        "zero": percent(0.0),
        "rows": rows,
    }


# --- pictures -------------------------------------------------------------------------------------


def _curves(figure: Figure, outcomes: Mapping[Cell, Outcome], seeds: Sequence[int]) -> Picture:
    with tempfile.TemporaryDirectory() as folder:
        stem = Path(folder) / figure.name
        (picture,) = figures.draw_curves(figure, outcomes, seeds, None, stem, (".png",))
        return Picture(figure.name, figures.caption(figure), _data("image/png", picture))


def _tasks(figure: Figure) -> Picture:
    caption = figures.caption(figure)
    with tempfile.TemporaryDirectory() as folder:
        try:
            (picture,) = figures.draw_tasks(figure, Path(folder) / figure.name, formats=(".png",))
        except (ModuleNotFoundError, SimulatorError) as error:
            return Picture(figure.name, caption, None, str(error))
        return Picture(figure.name, caption, _data("image/png", picture))


def _latents(table: LatentTable, root: Path, seeds: Sequence[int]) -> Picture | None:
    """The picture of latent states that classification leaves beside its numbers, if it has."""
    picture = latents_folder(root, table.backend, seeds[0]) / f"{table.name}.png"
    if not picture.exists():
        return None
    caption = "Latent states on their principal components, and the distances that ξ judges"
    return Picture(f"{table.name}-latents", caption, _data("image/png", picture))


def _data(kind: str, path: Path) -> str:
    return f"data:{kind};base64,{base64.b64encode(path.read_bytes()).decode()}"


def _films(runs: Mapping[Path, Run]) -> tuple[list[dict[str, Any]], list[str]]:
    """The videos as far as they fit, and the names of those that do not."""
    shown, left_out, size = [], [], 0
    for film in films(runs):
        bytes = film.path.stat().st_size
        if size + bytes > LARGEST_VIDEOS:
            left_out.append(_film_name(film))
            continue
        size += bytes
        shown.append(
            {
                "caption": film.caption,
                "columns": film.columns,
                "rows": film.rows,
                "data": _data("video/mp4", film.path),
            }
        )
    return shown, left_out


def _film_name(film: Film) -> str:
    return "/".join(film.path.parts[-3:])


# --- the rest -------------------------------------------------------------------------------------


def _together(
    tables: Sequence[ReturnsTable], outcomes: Mapping[Cell, Outcome], seeds: Sequence[int]
) -> list[tuple[str, str, list[tuple[str, str, str]]]]:
    """Each setting of a method over all targets all of whose agents are there: title, targets and
    rows of each method and metric that has any."""
    found = []
    for kind, method in (("ftl", "Fractional transfer"), ("meta", "Reward meta-models")):
        for metric in ("overall", "final"):
            entries = [
                comparison.compare(table, outcomes, seeds)
                for table in tables
                if table.kind == kind and table.metric == metric
            ]
            targets, aggregates = comparison.across_targets(entries)
            if targets:
                told = f"{len(targets)} of {len(TASKS)} targets: {', '.join(targets)}."
                found.append(
                    (f"{method}, {metric} return", told, list(map(_aggregate, aggregates)))
                )
    return found


def _aggregate(aggregate: Aggregate) -> tuple[str, str, str]:
    return (
        aggregate.name,
        interval(aggregate.average, 2),
        interval(aggregate.improvement, 2),
    )


def _provenance(
    root: Path, runs: Mapping[Path, Run]
) -> tuple[list[tuple[str, str, str, str, str]], list[str]]:
    """Each results folder: its agents, evaluations, revision and number of versions; and these."""
    rows: list[tuple[str, str, str, str, str]] = []
    versions: dict[str, int] = {}
    for folder in sorted({path.parent for path in root.glob(f"*/{CELLS}")}):
        if folder not in runs:
            rows.append((folder.name, "-", "-", "cannot be read", "-"))
            continue
        header = check_shape(read_sealed_json(folder / "run.json"), RUN, folder / "run.json")
        described = ", ".join(f"{k} {v}" for k, v in header.get("versions", {}).items())
        number = versions.setdefault(described or "unknown", len(versions) + 1)
        rows.append(
            (
                folder.name,
                str(len(runs[folder].outcomes)),
                f"{len(runs[folder].evaluations):,}",
                header.get("revision") or "unknown",
                str(number),
            )
        )
    return rows, list(versions)
