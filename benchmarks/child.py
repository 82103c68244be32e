"""Process of one measurement, started by `process.call`.

    python -m benchmarks.child MODULE:FUNCTION ARGUMENTS

calls the function with the arguments, a JSON object, and prints the returned value as JSON in the last line.
"""

from __future__ import annotations

import importlib
import json
import sys
from typing import Any

from benchmarks.process import UnavailableError


def answer(task: str, arguments: dict[str, Any]) -> dict[str, Any]:
    """Call a function; return its value, or the reason why it is unavailable."""
    module, function = task.split(":")
    try:
        return {"returned": getattr(importlib.import_module(module), function)(**arguments)}
    except ModuleNotFoundError as error:
        return {"unavailable": f"{error.name} is not installed"}
    except (ImportError, UnavailableError) as error:
        # A path follows in parentheses.
        return {"unavailable": str(error).splitlines()[0].split(" (")[0]}


if __name__ == "__main__":
    print("\n" + json.dumps(answer(sys.argv[1], json.loads(sys.argv[2]))))
