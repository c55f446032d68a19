"""What befalls a run in the midst of a round: it is stopped or killed, or the disk is full."""

from dreamer_jax.replay import Replay


class Killed(BaseException):
    """Stands for what ends a process without letting it save."""


def raising(error):
    def action(*arguments, **options):
        raise error

    return action


def in_call(patch, module, name, number, what):
    """Does something once the function of that name was called so many times: it has used up what
    it was given, and its results are not taken yet."""
    original, left = getattr(module, name), [number]

    def counting(*arguments, **options):
        left[0] -= 1
        result = original(*arguments, **options)
        if left[0] == 0:
            what()
        return result

    patch.setattr(module, name, counting)


def full_disk(patch, length):
    """Refuses to write a phase to streams of so many records."""
    append = Replay.append

    def full(self, records):
        if self.lengths[0, 0] == length:
            raise OSError("no space left")
        append(self, records)

    patch.setattr(Replay, "append", full)
