"""An extension of griffe: examples in docstrings, which begin with >>>, become blocks of code."""

import re

import griffe

EXAMPLE = re.compile(r"^( *)>>> .*?(?=\n\s*\n|\Z)", re.MULTILINE | re.DOTALL)


def fenced(match):
    indent, text = match[1], match[0].rstrip()
    return f"{indent}```pycon\n{text}\n{indent}```"


class Doctests(griffe.Extension):
    def on_object(self, *, obj, **_):
        if obj.docstring:
            obj.docstring.value = EXAMPLE.sub(fenced, obj.docstring.value)
