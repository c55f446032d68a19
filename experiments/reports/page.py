"""The report of a preset's results as one HTML page that needs no other file.

Pictures and videos are inside of it. It reads the results folders as they are, so it can be
written at any time; what is not complete is shown as such.
"""

import base64
import html
import tempfile
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from dreamer_jax.files import read_json
from dreamer_jax.logs import read_metrics
from envs import SimulatorError
from experiments.reports import comparison, figures, publication
from experiments.reports.comparison import Aggregate
from experiments.reports.outcomes import Outcome, read_classification, read_outcomes
from experiments.reports.publication import Box, Sheet
from experiments.runs.folder import CELLS, folders
from experiments.thesis import grid, published
from experiments.thesis.contradictions import CONTRADICTIONS
from experiments.thesis.grid import FIGURES, TABLES, TASKS, Backend, Cell, Figure, Table

STYLE = Path(__file__).with_name("page.css")
LARGEST_VIDEOS = 16 * 2**20
"""Bytes of all videos together; what does not fit is left out and named."""

ABOUT = (
    "Each place of a table shows our value above the published one of the thesis. <em>Overall</em> "
    "is the mean of all evaluation returns of a run, <em>final</em> that of the last tenth of its "
    "environment steps (section 4.2.3).",
    "± is the standard deviation of all these returns, of all seeds together. The thesis does not "
    "say its sense; its numbers do. Among three numbers of which none exceeds M, the deviation is "
    "at most √2 (M − mean), or √3 with n − 1 in place of n. InvertedPendulum's baseline ends at "
    "883 ± 17, so none of its three seeds is much above 907, and their means cannot deviate by "
    "more than 260 from 723 (311 with n − 1). Yet 723 ± 364 is printed, and all 13 overall "
    "deviations of that task whose final one is not a copy are too large in this way. The same "
    "bound rules out the deviation of the seeds at each evaluation, averaged over evaluations. "
    "What is left is the deviation over evaluations, which contains the rise of the learning "
    "curve. Final deviations are read in the same way; for these the numbers do not tell it from "
    "a deviation of three seeds' means.",
    "A transfer is <em>positive</em> or <em>negative</em> where the 95% bootstrap interval of its "
    "mean score less the baseline's excludes 0, and <em>neutral</em> otherwise. A run gives one "
    "score. With three seeds such intervals are too short: on normal samples they hold the truth "
    "in about 80% of cases, not 95%. Read a verdict on three seeds as a hint.",
    "IQM is the interquartile mean of scores, which for fewer than four seeds is their mean; "
    "P(improvement) the probability that a run beats one of the baseline.",
)


class Section(NamedTuple):
    """A part of the page.

    Attributes:
      id: of its anchor.
      title: above it.
      body: HTML.
      entries: names of the tables and figures in it.
    """

    id: str
    title: str
    body: str
    entries: tuple[str, ...] = ()


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
    root, path, seeds = Path(root), Path(path), tuple(seeds)
    tables = {name: grid.on_backend(table, backend) for name, table in TABLES.items()}
    pictures = {name: grid.on_backend(figure, backend) for name, figure in FIGURES.items()}
    shown = [
        cell
        for entry in (*tables.values(), *pictures.values())
        for cell in grid.shown(entry, seeds)
    ]
    cells = grid.closure(shown)
    outcomes = read_outcomes(root, cells)
    sections = [
        Section("reading", "How to read this", "".join(f"<p>{text}</p>" for text in ABOUT)),
        *_chapters(tables, pictures, outcomes, root, seeds),
        Section("together", "All targets together", _together(tables, outcomes, seeds)),
        Section("videos", "Videos", _videos(root)),
        Section("contradictions", "Contradictions of the thesis", _contradictions()),
        Section("provenance", "Where the numbers come from", _provenance(root)),
    ]
    contents = "".join(map(_contents, sections))
    body = "".join(
        f'<section id="{section.id}"><h2>{section.title}</h2>{section.body}</section>'
        for section in sections
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>Multi-source transfer with Dreamer, preset {_text(root.name)}</title>"
        f"<style>{STYLE.read_text(encoding='utf-8')}</style></head><body>"
        f"{_head(root, seeds, backend, outcomes)}<nav><ul>{contents}</ul></nav>{body}"
        "</body></html>\n",
        encoding="utf-8",
    )
    return path


def _text(value: object) -> str:
    return html.escape(str(value))


def _contents(section: Section) -> str:
    entries = ", ".join(
        f'<a href="#{name}">{name.replace("-", " ")}</a>' for name in section.entries
    )
    more = f'<br><span class="muted">{entries}</span>' if entries else ""
    return f'<li><a href="#{section.id}">{section.title}</a>{more}</li>'


def _head(root: Path, seeds, backend: str, outcomes: Mapping[Cell, Outcome]) -> str:
    states = Counter(outcome.state for outcome in outcomes.values())
    done = sum(len(outcome.env_steps) for outcome in outcomes.values())
    simulator = {"bullet": "PyBullet", "brax": "Brax"}[backend]
    size = publication.size_note(root)
    return (
        "<h1>Multi-source transfer with Dreamer: our results beside the thesis's</h1>"
        f"<p>Preset {_text(root.name)}, {simulator}, seeds {', '.join(map(str, seeds))}. "
        f"Of {len(outcomes)} agents {states['complete']} are complete, {states['incomplete']} "
        f"incomplete and {states['missing']} have not begun; {done:,} evaluations were made.</p>"
        + (
            ""
            if size is None
            else f'<p class="size">{_text(size.capitalize())} with the thesis.</p>'
        )
    )


# --- tables and figures ---------------------------------------------------------------------------


def _chapters(tables, pictures, outcomes, root: Path, seeds) -> list[Section]:
    """The tables and figures: targets, classification, meta-models, others."""
    size = publication.size_note(root)

    def show(entry: Table | Figure) -> str:
        if isinstance(entry, Figure):
            return _figure(entry, outcomes, size, seeds)
        if entry.kind == "ltc":
            found = read_classification(root, entry, seeds)
            sheet = publication.classification_sheet(entry, found, size)
            return _sheet(entry, sheet) + _latents(entry, root, seeds)
        return _sheet(entry, publication.returns_sheet(entry, outcomes, seeds, size))

    def section(id: str, title: str, kind: str, task: str | None = None) -> Section:
        entries = [
            *(t for t in tables.values() if t.kind == kind and task in (None, *t.targets)),
            *(f for f in pictures.values() if f.kind == kind and task in (None, *f.tasks)),
        ]
        return Section(id, title, "".join(map(show, entries)), tuple(e.name for e in entries))

    return [
        section("tasks", "The tasks", "tasks"),
        *(section(f"ftl-{task}", f"Fractional transfer to {task}", "ftl", task) for task in TASKS),
        section("ltc", "Latent task classification", "ltc"),
        section("meta", "Reward meta-models", "meta"),
        section("baselines", "Agents from scratch", "baselines"),
        section("multitask", "Agents of several tasks", "multitask"),
    ]


def _rows(rows: Iterable[Iterable[str]], header: Iterable[str], kind: str = "") -> str:
    """An HTML table; its cells are HTML, not plain text."""
    head = "".join(f'<th scope="col">{text}</th>' for text in header)
    lines = []
    for name, *places in rows:
        places = "".join(f"<td>{text}</td>" for text in places)
        lines.append(f'<tr><th scope="row">{name}</th>{places}</tr>')
    return (
        f'<div class="scroll" tabindex="0"><table class="{kind}"><thead><tr>{head}</tr></thead>'
        f"<tbody>{''.join(lines)}</tbody></table></div>"
    )


def _sheet(table: Table, sheet: Sheet) -> str:
    rows = [(_text(name), *map(_box, boxes)) for name, boxes in sheet.rows]
    parts = [
        f'<h3 id="{table.name}">{_text(sheet.title)}</h3>',
        f'<p class="note">{_text(sheet.caption)} Ours above the published.</p>',
        _rows(rows, map(_text, sheet.header)),
    ]
    parts += [f'<p class="note">{_text(note)}</p>' for note in sheet.notes]
    if sheet.statistics:
        header, *body = sheet.statistics
        rows = [[_verdict(text) for text in row] for row in body]
        parts.append(
            "<details><summary>Statistics</summary>"
            f'<p class="note">{_text(publication.STATISTICS_CAPTION)}</p>'
            f"{_rows(rows, map(_text, header))}</details>"
        )
    return "".join(parts)


def _box(box: Box | None) -> str:
    if box is None:
        return ""
    verdict = "" if box.verdict is None else _verdict(box.verdict)
    return (
        f'<span class="ours{"" if box.complete else " open"}">{_text(box.ours)}</span>'
        f'<span class="told">{_text(box.published)}</span>{verdict}'
    )


def _verdict(text: str) -> str:
    if text in publication.COLOURS:
        return f'<span class="verdict {text}">{text}</span>'
    return _text(text)


def _figure(
    figure: Figure, outcomes: Mapping[Cell, Outcome], size: str | None, seeds: Sequence[int]
) -> str:
    caption = _text(figures.caption(figure))
    cells = grid.shown(figure, seeds)
    if cells and not any(outcomes[cell].env_steps for cell in cells):
        return _captioned(figure.name, _open("not run"), caption)
    with tempfile.TemporaryDirectory() as folder:
        stem = Path(folder) / figure.name
        try:
            if figure.kind == "tasks":
                (picture,) = figures.draw_tasks(figure, stem, formats=(".png",))
            else:
                (picture,) = figures.draw_curves(figure, outcomes, seeds, size, stem, (".png",))
        except (ModuleNotFoundError, SimulatorError) as error:
            return _captioned(figure.name, _open(error), caption)
        return _captioned(figure.name, _image(picture, caption), caption)


def _latents(table: Table, root: Path, seeds) -> str:
    """The picture of latent states that classification leaves beside its numbers, if it has."""
    picture = root / f"latents-{table.backend}-seed-{seeds[0]}" / f"{table.name}.png"
    if not picture.exists():
        return ""
    caption = "Latent states on their principal components, and the distances that ξ judges"
    return _captioned(f"{table.name}-latents", _image(picture, caption), caption)


def _captioned(id: str, content: str, caption: str) -> str:
    return f'<figure id="{id}">{content}<figcaption>{caption}</figcaption></figure>'


def _open(text: object) -> str:
    return f'<p class="open">{_text(text)}</p>'


def _image(picture: Path, description: str) -> str:
    return f'<img alt="{description}" src="{_data("image/png", picture)}">'


def _data(kind: str, path: Path) -> str:
    return f"data:{kind};base64,{base64.b64encode(path.read_bytes()).decode()}"


# --- the rest -------------------------------------------------------------------------------------


def _together(tables: Mapping[str, Table], outcomes: Mapping[Cell, Outcome], seeds) -> str:
    """Each setting of a method over all targets that are complete."""
    parts = [
        "<p>Interquartile means over the runs of all targets whose agents are complete, each "
        "target's scores scaled so that its lowest run is 0 and its highest 1; probability of "
        "improvement averaged over targets. Runs are drawn anew within each target.</p>"
    ]
    for kind, method in (("ftl", "fractional transfer"), ("meta", "reward meta-models")):
        for metric in ("overall", "final"):
            entries = [
                comparison.compare(table, outcomes, seeds)
                for table in tables.values()
                if table.kind == kind and table.metric == metric
            ]
            targets, aggregates = comparison.across_targets(entries)
            parts.append(f"<h3>{method.capitalize()}, {metric} return</h3>")
            if not targets:
                parts.append(_open("No target is complete yet."))
                continue
            parts.append(
                f'<p class="note">{len(targets)} of {len(TASKS)} targets: {", ".join(targets)}.</p>'
            )
            parts.append(_rows(map(_aggregate, aggregates), ("", "IQM", "P(improvement)")))
    return "".join(parts)


def _aggregate(aggregate: Aggregate) -> tuple[str, str, str]:
    return (
        _text(aggregate.name),
        publication.interval(aggregate.average, 2),
        publication.interval(aggregate.improvement, 2),
    )


def _videos(root: Path) -> str:
    """The newest video of each run, and its prediction, as far as they fit."""
    shown, left_out, size = [], [], 0
    for pattern in ("evaluation_*.mp4", "evaluate_*.mp4", "prediction_*.mp4"):
        for folder in sorted({path.parent for path in root.glob(f"*/videos/{pattern}")}):
            # Names end in environment steps or a task; the last is the newest.
            path = sorted(folder.glob(pattern))[-1]
            if size + path.stat().st_size > LARGEST_VIDEOS:
                left_out.append(path)
                continue
            size += path.stat().st_size
            name = _text(path.relative_to(root))
            video = f'<video controls preload="metadata" src="{_data("video/mp4", path)}"></video>'
            shown.append(f"<figure>{video}<figcaption>{name}</figcaption></figure>")
    if not shown and not left_out:
        return _open("There are none yet.")
    text = f'<div class="videos">{"".join(shown)}</div>'
    if left_out:
        names = ", ".join(_text(path.relative_to(root)) for path in left_out)
        text += (
            f'<p class="note">Left out, because all videos together may have '
            f"{LARGEST_VIDEOS / 2**20:.0f} MiB: {names}.</p>"
        )
    return text


def _contradictions() -> str:
    rows = [(_text(c.what), _text(c.where), _text(c.choice)) for c in CONTRADICTIONS]
    return _rows(rows, ("In the thesis", "Where", "Here"), "text")


def _provenance(root: Path) -> str:
    """Each results folder: its agents, evaluations, revision and versions."""
    rows, versions = [], {}
    for folder in sorted({folder for folder, _ in folders(root).values()}):
        try:
            header = read_json(folder / "run.json")
            names = read_json(folder / CELLS)
            found = read_metrics(folder) if (folder / "metrics.jsonl").exists() else []
        except (OSError, ValueError) as error:
            rows.append((_text(folder.name), "-", "-", _text(error), "-"))
            continue
        done = sum(row["kind"] == "evaluation" for row in found)
        described = ", ".join(f"{k} {v}" for k, v in header.get("versions", {}).items())
        number = versions.setdefault(described or "unknown", len(versions) + 1)
        rows.append(
            (
                _text(folder.name),
                str(len(names)),
                f"{done:,}",
                f"<code>{_text(header.get('revision') or 'unknown')}</code>",
                str(number),
            )
        )
    published_count = len(published.records())
    text = (
        f"<p>Published: {published_count} entries of tables 1 to 17, of PyBullet and the preset "
        "thesis. Ours: the folders below.</p>"
    )
    if not rows:
        return text + _open("There are none yet.")
    columns = ("Results folder", "Agents", "Evaluations", "Revision", "Versions")
    listed = "".join(f"<li>{_text(described)}</li>" for described in versions)
    return (
        text + _rows(rows, columns) + f'<p class="note">Versions:</p><ol class="note">{listed}</ol>'
    )
