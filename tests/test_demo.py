"""A demo from an agent of its own sizes, and what showcases say, of made-up returns."""

import dataclasses

import numpy as np
import pytest

from dreamer_jax.config import preset
from experiments.cli.main import main
from experiments.methods.fractional import FractionalTransfer
from experiments.reports import showcase
from experiments.reports.outcomes import Outcome, Run
from experiments.reports.showcase import Panel, effects, sentence, write_film
from experiments.runs.spec import RunSpec
from runs import spec_of, write_run

PENDULUM = "bullet/inverted_pendulum"
STEPS = (1000, 2000, 3000)


def run_of(curves, omegas=(0.0, 0.2), baseline=True, seeds=5):
    """A run whose members have these returns: [groups][seeds][evaluations]."""
    method = FractionalTransfer(sources=("source",), omegas=omegas, baseline=baseline)
    spec = RunSpec((PENDULUM,), tuple(range(seeds)), preset("debug"), method)
    outcomes = [
        Outcome(STEPS, {PENDULUM: tuple(map(float, curve))}, len(STEPS), STEPS[-1])
        for group in curves
        for curve in group
    ]
    return Run("folder", spec, tuple(outcomes), ())


def group(start, end, seeds=5):
    """Curves from one return to another, each seed one higher than the one before."""
    return [np.linspace(start, end, len(STEPS)) + seed for seed in range(seeds)]


def test_an_effect_is_the_difference_of_the_mean_returns():
    run = run_of([group(0, 200), group(100, 500), group(-800, -600)])
    lower, higher = effects(run, PENDULUM)
    assert (lower.label, higher.label) == ("omega=0", "omega=0.2")
    # Means of the curves: 100, 300 and -700, and the same spread of 2 around each.
    assert (lower.difference, higher.difference) == pytest.approx((800, 1000))
    # Scores 0 to 4 in each group have a variance of 2.5; t with 8 degrees of freedom is 2.306.
    assert higher.high - higher.difference == pytest.approx(2.306, abs=1e-3)
    assert lower.verdict == higher.verdict == "positive"
    # The targets begin above what agents from scratch end with.
    assert lower.reached == higher.reached == 1000


def test_the_step_is_named_at_which_targets_have_what_scratch_ends_with():
    run = run_of([group(-1000, 0), group(-1000, -900), group(-1000, -600)])
    assert [effect.reached for effect in effects(run, PENDULUM)] == [2000, None]


def test_a_sentence_says_how_much_better_with_its_interval():
    told = sentence(run_of([group(0, 200), group(100, 500), group(-800, -600)]), PENDULUM, "zoo:a")
    assert told == (
        "InvertedPendulum: agents from zoo:a (omega=0.2) do better than from scratch (+1000, 95 % "
        "interval +998 to +1002, 5 seeds on either side, mean return over 3,000 environment "
        "steps); what agents from scratch have after 3,000 steps, a mean of -598, they have after "
        "1,000."
    )


def test_a_sentence_says_that_a_transfer_does_harm():
    told = sentence(run_of([group(-900, -900), group(0, 0), group(0, 200)]), PENDULUM, "zoo:a")
    assert "(omega=0) do worse than from scratch (-1000, " in told


def test_a_sentence_says_that_no_difference_is_seen():
    wide = [np.full(3, score) for score in (-800, -400, 0, 400, 800)]
    told = sentence(run_of([wide, wide, group(-100, 100)]), PENDULUM, "zoo:a")
    assert told.startswith("InvertedPendulum: no difference is seen between agents from zoo:a and")


def test_two_seeds_are_too_few_to_say():
    curves = [group(0, 200, 2), group(100, 500, 2), group(-800, -600, 2)]
    told = sentence(run_of(curves, seeds=2), PENDULUM, "zoo:a")
    assert "2 seeds are too few to say what the transfer from zoo:a does" in told


def test_a_run_without_agents_from_scratch_or_not_done_has_no_effect():
    with pytest.raises(ValueError, match="no transfer targets beside agents from scratch"):
        effects(run_of([group(0, 1), group(0, 1)], baseline=False), PENDULUM)
    run = run_of([group(0, 1), group(0, 1), group(0, 1)])
    cut = dataclasses.replace(run.outcomes[3], planned=4)
    outcomes = (*run.outcomes[:3], cut, *run.outcomes[4:])
    with pytest.raises(ValueError, match="omega=0, seed 3 of folder is cut"):
        effects(dataclasses.replace(run, outcomes=outcomes), PENDULUM)


def test_a_film_is_as_long_as_its_shortest_panel(tmp_path, monkeypatch):
    written = {}
    monkeypatch.setattr(
        showcase, "write_video", lambda path, frames, fps: written.update({path: frames}) or path
    )
    panels = [Panel(name, np.zeros((count, 32, 32, 3), np.uint8)) for name, count in ABOUT]
    write_film(panels, tmp_path / "film.mp4")
    assert written[tmp_path / "film.mp4"].shape[0] == 4


ABOUT = (("one", 6), ("two", 4))


def test_the_demo_trains_tells_and_shows(tmp_path, capsys):
    pytest.importorskip("pybullet")
    write_run(tmp_path / "source", spec_of("inverted_pendulum"))
    # Six agents, as many as in tests/test_tables.py: they share their compiled functions.
    words = ["demo", "--preset", "debug", "--results", str(tmp_path / "results")]
    words += ["--seeds", "0", "1", "--source", str(tmp_path / "source")]
    assert main(words) == 0
    output = capsys.readouterr().out
    assert "reward/out/kernel" in output and "fraction(omega=0..0.2)" in output
    for label in ("omega=0", "omega=0.2", "baseline"):
        assert any(line.startswith(label) and "±" in line for line in output.splitlines())
    assert "InvertedPendulum: 2 seeds are too few" in output.splitlines()[-1]
    folder = tmp_path / "results" / "debug" / "demo"
    for name in ("curves.png", "videos/beside_each_other.mp4"):
        assert (folder / name).stat().st_size > 1000
        assert f"wrote {folder / name}" in output
    before = (folder / "metrics.jsonl").read_bytes()
    assert main(words) == 0
    assert (folder / "metrics.jsonl").read_bytes() == before
