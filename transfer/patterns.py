r"""Patterns over paths: globs that remember what they stood for.

A *pattern* is a glob over the parts of a '/'-joined path:

=======================  ========================================================
`reward/out/*`         `*` and `?` and `[ab]` match inside one part
`dynamics/**`          `**` stands for any number of parts, none included
`layers/{i}/kernel`    `{i}` matches as `*` does, one character at least, and
                         is remembered by its name; `{i:**}` matches as `**`
`!dynamics/gru/*`      `!` takes leaves away from what came before it
`w\[0]`, `\!w`     a backslash makes the next character an ordinary one
=======================  ========================================================

`escape` writes the pattern of one path, whatever characters it holds.
"""

import difflib
import functools
import re
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple


def match(pattern: str, path: str) -> bool:
    """Whether a pattern (without a leading `!`) matches a whole path.

    >>> match("dynamics/**/kernel", "dynamics/prior/out/kernel"), match("*/out", "reward/out/bias")
    (True, False)
    """
    return captures(pattern, path) is not None


def captures(pattern: str, path: str) -> dict[str, str] | None:
    """What the named parts of a pattern stand for in a path; `None` if it does not match.

    A name that comes twice stands for the same text twice. Of several ways to match, each
    wildcard takes as few parts as it can, the first of them first.

    Raises:
      ValueError: a pattern that cannot be read, such as `{1st}`.

    >>> captures("layers/{i}/{rest:**}", "layers/3/attention/kernel")
    {'i': '3', 'rest': 'attention/kernel'}
    """
    wanted = [_part(part) for part in pattern.split("/")]
    parts = path.split("/") if path else []
    found: dict[str, str] = {}
    at = position = 0
    # Where to go on after a mismatch: the last "**" takes one part more. One such place is enough,
    # as for the "*" of a file name, so no pattern takes more than parts x parts comparisons.
    retry: tuple[int, str | None, int, int, dict[str, str]] | None = None
    while True:
        part = wanted[at] if at < len(wanted) else None
        if isinstance(part, _Several):
            retry = (at, part.name, position, position, dict(found))
            found, at = _with(found, part.name, ""), at + 1
            continue
        if part is None and position == len(parts):
            return found
        if part is not None and position < len(parts):
            hit = part.fullmatch(parts[position])
            named = found if hit is None else _merged(found, hit.groupdict())
            if hit is not None and named is not None:
                found, at, position = named, at + 1, position + 1
                continue
        if retry is None or retry[3] >= len(parts):
            return None
        at, name, start, end, before = retry
        retry = (at, name, start, end + 1, before)
        position = end + 1
        found = _with(before, name, "/".join(parts[start:position]))
        at += 1


class _Several(NamedTuple):
    """`**`, or `{name:**}`."""

    name: str | None


def _with(found: dict[str, str], name: str | None, value: str) -> dict[str, str]:
    return found if name is None else {**found, name: value}


def _merged(found: dict[str, str], new: dict[str, str]) -> dict[str, str] | None:
    """Both together, or `None` where they differ."""
    if any(found.get(name, value) != value for name, value in new.items()):
        return None
    return {**found, **new}


_NAMED = re.compile(r"\{([^{}/]*)\}")


@functools.lru_cache(maxsize=4096)
def _part(part: str) -> "re.Pattern[str] | _Several":
    """One part of a pattern as a regular expression that never goes back."""
    if part == "**":
        return _Several(None)
    named = _NAMED.fullmatch(part)
    if named and named[1].endswith(":**"):
        return _Several(_checked_name(part, named[1].removesuffix(":**")))
    # Text and wildcards in turn. Each wildcard with the text behind it is an atomic group: the
    # first place where the text fits is as good as any later one.
    pieces: list[tuple[str, str]] = [("", "")]
    seen: set[str] = set()
    index = 0
    while index < len(part):
        character, rest = part[index], part[index:]
        wildcard, text, length = "", re.escape(character), 1
        if character == "\\" and len(rest) > 1:
            text, length = re.escape(rest[1]), 2
        elif character == "*":
            wildcard, text = ".*", ""
        elif character == "?":
            text = "."
        elif character == "[" and (end := _end_of_class(rest)):
            inside = rest[1:end].replace("\\", "\\\\").replace("[", "\\[")
            inside = "^" + inside[1:] if inside.startswith("!") else re.sub(r"^\^", r"\\^", inside)
            text, length = f"[{inside}]", end + 1
        elif character == "{" and (named := _NAMED.match(rest)):
            name, length = _checked_name(part, named[1]), named.end()
            wildcard, text = (f"(?P<{name}>.+)", "") if name not in seen else ("", f"(?P={name})")
            seen.add(name)
        if wildcard:
            pieces.append((wildcard, ""))
        else:
            pieces[-1] = (pieces[-1][0], pieces[-1][1] + text)
        index += length
    expression = pieces[0][1]
    for number, (wildcard, text) in enumerate(pieces[1:], start=2):
        if number < len(pieces):
            lazy = wildcard.replace(".*", ".*?").replace(".+", ".+?")
            expression += f"(?>{lazy}{text})" if text else f"(?>{lazy})"
        else:
            expression += wildcard + text
    try:
        return re.compile(expression, re.DOTALL)
    except re.error as error:
        raise ValueError(f"The pattern {part!r} cannot be read: {error}.") from None


def _end_of_class(text: str) -> int | None:
    """The place of the bracket that closes the class which `text` begins with."""
    end = text.find("]", 3 if text.startswith("[!") else 2)
    return end if end > 0 else None


def _checked_name(part: str, name: str) -> str:
    if not name.isidentifier():
        raise ValueError(
            f"The pattern {part!r} names a part {name!r}; expected a word, as in {{layer}} or "
            "{rest:**}. An ordinary brace is written \\{."
        )
    return name


def escape(path: str) -> str:
    r"""The pattern that matches exactly this path, whatever characters its keys hold.

    >>> print(escape("w[0]/*"), escape("!b"))
    w\[0]/\* \!b
    """
    escaped = re.sub(r"([\\*?\[{])", r"\\\1", path)
    return "\\" + escaped if escaped.startswith("!") else escaped


def suggest(pattern: str, names: Iterable[str]) -> str:
    """Near misses for an error message: leaves, and branches written as `branch/**`."""
    names = list(names)
    branches = sorted(
        {
            "/".join(name.split("/")[:depth])
            for name in names
            for depth in range(1, name.count("/") + 1)
        }
    )
    wanted = pattern.removeprefix("!")
    if wanted.rstrip("/") in branches:
        return f"; did you mean {escape(wanted.rstrip('/'))}/**?"
    choices = {name: escape(name) for name in names}
    choices |= {f"{branch}/**": f"{escape(branch)}/**" for branch in branches}
    # A bracket or star that stands for itself is the likeliest miss of all.
    if wanted in names:
        near = [wanted]
    else:
        near = difflib.get_close_matches(wanted, choices, n=4)
    if near:
        return f"; did you mean {', '.join(choices[name] for name in near)}?"
    listed = ", ".join(names[:8]) + (f", ... ({len(names)} in all)" if len(names) > 8 else "")
    return f"; the leaves are {listed or 'none'}"


def pattern_list(patterns: Sequence[Any]) -> tuple[str, ...]:
    """Patterns given one by one or as lists, as one tuple.

    Raises:
      ValueError: what is given is no string, or nothing is given.
    """
    found: list[str] = []
    for pattern in patterns:
        found += [pattern] if isinstance(pattern, str) or not is_list(pattern) else pattern
    for pattern in found:
        if not isinstance(pattern, str):
            raise ValueError(
                f"A pattern is a string such as 'encoder/**'; got {pattern!r} "
                f"({type(pattern).__name__})."
            )
    if not found:
        raise ValueError("No pattern was given; '**' selects every leaf.")
    return tuple(found)


def is_list(value: Any) -> bool:
    return isinstance(value, list | tuple | set | frozenset)


def match_paths(names: Sequence[str], *patterns: Any, optional: bool = False) -> frozenset[str]:
    """The names among `names` that the patterns select, taken in order.

    Raises:
      ValueError: a pattern matches no name at all, unless `optional`; the message lists near
        misses.
    """
    patterns = pattern_list(patterns)
    chosen: set[str] = set(names) if patterns[0].startswith("!") else set()
    for pattern in patterns:
        found = {name for name in names if match(pattern.removeprefix("!"), name)}
        if not found and not optional:
            raise ValueError(f"Pattern {pattern!r} matches no leaf{suggest(pattern, names)}.")
        chosen = chosen - found if pattern.startswith("!") else chosen | found
    return frozenset(chosen)
