"""Nobody has to read what a run says."""

import io
import os
import subprocess
import sys

import pytest

from dreamer_jax.output import SafeStream
from dreamer_jax.progress import Progress


def test_letters_that_an_encoding_lacks_become_question_marks():
    raw = io.BytesIO()
    stream = SafeStream(io.TextIOWrapper(raw, encoding="ascii"))
    with Progress(10, stream=stream, description="ω") as bar:
        bar.message("50 ± 2")
    stream.flush()
    assert b"50 ? 2" in raw.getvalue()


@pytest.mark.parametrize("closing", ["pipe", "closed here", "full disk"])
def test_progress_goes_on_where_nobody_reads(closing, tmp_path):
    if closing == "full disk":
        stream = open("/dev/full", "w")
    else:
        reader, writer = os.pipe()
        stream = open(writer, "w")
        os.close(reader)
        if closing == "closed here":
            try:
                stream.close()
            except BrokenPipeError:
                pass
    with Progress(10, stream=stream, interval=0.0) as bar:
        for step in range(10):
            bar.update(env_steps=step, phase="collecting")
            bar.message("a message")


CLOSED = """
import sys
from dreamer_jax.output import safe_output
with safe_output():
    for number in range(100_000):
        print("line", number)
sys.stderr.write("to the end")
"""


def test_a_program_whose_reader_leaves_runs_to_its_end():
    process = subprocess.Popen(
        [sys.executable, "-c", CLOSED], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    assert process.stdout.readline() == b"line 0\n"
    process.stdout.close()
    assert process.stderr.read() == b"to the end"
    assert process.wait(timeout=60) == 0
