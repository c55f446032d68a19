"""A folder is written by one process at a time."""

import multiprocessing
import os
import socket

import pytest

from dreamer_jax.locks import FolderInUseError, FolderLock, Presence


def hold(directory, ready, leave):
    with FolderLock(directory):
        ready.set()
        leave.wait(60)


def test_the_second_process_is_told_which_one_holds_the_folder(tmp_path):
    context = multiprocessing.get_context("spawn")
    ready, leave = context.Event(), context.Event()
    holder = context.Process(target=hold, args=(tmp_path, ready, leave))
    holder.start()
    assert ready.wait(60)
    with pytest.raises(
        FolderInUseError,
        match=rf"in use by process {holder.pid} on {socket.gethostname()}, since 20\d\d-",
    ):
        FolderLock(tmp_path)
    # However its process ends.
    holder.kill()
    holder.join()
    FolderLock(tmp_path).release()


def test_locks_of_other_names_and_of_other_folders_are_others(tmp_path):
    with FolderLock(tmp_path), FolderLock(tmp_path, ".evaluation"), FolderLock(tmp_path / "inside"):
        with pytest.raises(FolderInUseError):
            FolderLock(tmp_path)


def test_a_file_in_the_folders_place_is_named(tmp_path):
    (tmp_path / "file").write_text("")
    for path in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(NotADirectoryError, match="file.* choose another place"):
            FolderLock(path)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_a_folder_that_cannot_be_written_is_told_as_such(tmp_path):
    tmp_path.chmod(0o500)
    with pytest.raises(OSError, match="could not lock"):
        FolderLock(tmp_path)


def test_who_comes_first_is_alone_until_the_last_has_left(tmp_path):
    with Presence(tmp_path) as first, Presence(tmp_path) as second:
        assert (first.alone, second.alone) == (True, False)
        first.release()
        with Presence(tmp_path) as third:
            assert not third.alone
    with Presence(tmp_path / "elsewhere") as other, Presence(tmp_path) as again:
        assert other.alone and again.alone
