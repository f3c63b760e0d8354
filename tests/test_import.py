"""Importing the package leaves the interpreter as it was."""

import subprocess
import sys

import pytest

FAILING = "import sys; sys.modules['mbagent.agent'] = None"


@pytest.mark.parametrize(("before", "enabled"), [("pass", True), ("import gc; gc.disable()", False), (FAILING, True)])
def test_garbage_is_collected_afterwards_if_it_was_before(before: str, enabled: bool) -> None:
    code = f"{before}\nimport gc, contextlib\nwith contextlib.suppress(ImportError):\n    import mbagent\nprint(gc.isenabled())"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == str(enabled)
