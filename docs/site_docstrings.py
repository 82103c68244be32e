"""Extension of Griffe: the section `Example:` of docstrings is one of code, as `Examples:` is."""

from __future__ import annotations

import re

from griffe import Extension, Object


class Examples(Extension):  # type: ignore[misc]
    """Rename the section in every docstring."""

    def on_object(self, *, obj: Object, **_: object) -> None:
        """Rename the section in the docstring of one object."""
        if obj.docstring is not None:
            obj.docstring.value = re.sub(r"^Example:$", "Examples:", obj.docstring.value, flags=re.MULTILINE)
