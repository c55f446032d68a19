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

from dreamer_jax.files import read_json
from dreamer_jax.logs import read_metrics
from experiments import comparison, figures, grid, publication, published, results
from experiments.comparison import Aggregate
from experiments.contradictions import CONTRADICTIONS
from experiments.grid import FIGURES, TABLES, TASKS, Backend, Cell, Figure, Table
from experiments.publication import Box, Sheet
from experiments.results import Outcome

STYLE = Path(__file__).with_name("page.css")
LARGEST_VIDEOS = 16 * 2**20
"""Bytes of all videos together; what does not fit is left out and named."""

ABOUT = (
    "Each place of a table shows our value above the published one of the thesis. <em>Overall</em> "
    "is the mean of all evaluation returns of a run, <em>final</em> that of the last tenth of its "
    "environment steps (section 4.2.3).",
    "± is the standard deviation of all these returns, of all seeds together. The thesis does not "
    "say its sense; its numbers do. Among three numbers that do not exceed M the deviation is at "
    "most √2 (M − mean), or √3 with n − 1 in place of n. InvertedPendulum's agents end near 880 ± "
    "30, so their seeds' means could not deviate by more than about 260 from 723, and yet 723 ± "
    "364 is printed for the baseline; the same holds for each of the 13 overall deviations of that "
    "task whose final one is not a copy. Nor can it be the deviation of three seeds at each "
    "evaluation, averaged. What is left is the deviation over evaluations, which contains the rise "
    "of the learning curve. Final deviations are read in the same way; for these the numbers do "
    "not tell it from a deviation of three seeds' means.",
    "A transfer is <em>positive</em> or <em>negative</em> where the 95% bootstrap interval of its "
    "mean score less the baseline's excludes 0, and <em>neutral</em> otherwise. A run gives one "
    "score. With three seeds such intervals are too short: on normal samples they hold the truth "
    "in about 80% of cases, not 95%. Read a verdict on three seeds as a hint.",
    "IQM is the interquartile mean of scores, which for fewer than four seeds is their mean; "
    "P(improvement) the probability that a run beats one of the baseline.",
)


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
    outcomes = results.read_outcomes(root, cells)
    sections = [
        ("reading", "How to read this", "".join(f"<p>{text}</p>" for text in ABOUT)),
        *_chapters(tables, pictures, outcomes, root, seeds),
        ("together", "All targets together", _together(tables, outcomes, seeds)),
        ("videos", "Videos", _videos(root)),
        ("contradictions", "Contradictions of the thesis", _contradictions()),
        ("provenance", "Where the numbers come from", _provenance(root)),
    ]
    contents = "".join(f'<li><a href="#{id}">{title}</a></li>' for id, title, _ in sections)
    body = "".join(
        f'<section id="{id}"><h2>{title}</h2>{text}</section>' for id, title, text in sections
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
        + ("" if size is None else f'<p class="size">{_text(size.capitalize())}.</p>')
    )


# --- tables and figures ---------------------------------------------------------------------------


def _chapters(tables, pictures, outcomes, root: Path, seeds) -> list[tuple[str, str, str]]:
    """The tables and figures: targets, classification, meta-models, others."""

    def show(*entries: Table | Figure) -> str:
        parts = []
        for entry in entries:
            if isinstance(entry, Figure):
                parts.append(_figure(entry, outcomes, root, seeds))
            elif entry.kind == "ltc":
                found = results.read_classification(root, entry, seeds)
                sheet = publication.classification_sheet(entry, found, publication.size_note(root))
                parts.append(_sheet(entry, sheet) + _latents(entry, root, seeds))
            else:
                size = publication.size_note(root)
                sheet = publication.returns_sheet(entry, outcomes, seeds, size)
                parts.append(_sheet(entry, sheet))
        return "".join(parts)

    def those(kind: str, task: str | None = None) -> list[Table | Figure]:
        found = [table for table in tables.values() if table.kind == kind]
        found += [figure for figure in pictures.values() if figure.kind == kind]
        if task is None:
            return found
        return [e for e in found if task in (e.targets if isinstance(e, Table) else e.tasks)]

    return [
        ("tasks", "The tasks", show(*those("tasks"))),
        *(
            (f"ftl-{task}", f"Fractional transfer to {task}", show(*those("ftl", task)))
            for task in TASKS
        ),
        ("ltc", "Latent task classification", show(*those("ltc"))),
        ("meta", "Reward meta-models", show(*those("meta"))),
        ("baselines", "Agents from scratch", show(*those("baselines"))),
        ("multitask", "Agents of several tasks", show(*those("multitask"))),
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


def _figure(figure: Figure, outcomes: Mapping[Cell, Outcome], root: Path, seeds) -> str:
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
                size = publication.size_note(root)
                (picture,) = figures.draw_curves(figure, outcomes, seeds, size, stem, (".png",))
        except ModuleNotFoundError as error:
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
    for folder in sorted({folder for folder, _ in results.folders(root).values()}):
        header = read_json(folder / "run.json")
        names = read_json(folder / results.CELLS)
        found = read_metrics(folder) if (folder / "metrics.jsonl").exists() else []
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
    header = ("Results folder", "Agents", "Evaluations", "Revision", "Versions")
    listed = "".join(f"<li>{_text(described)}</li>" for described in versions)
    return (
        text + _rows(rows, header) + f'<p class="note">Versions:</p><ol class="note">{listed}</ol>'
    )
