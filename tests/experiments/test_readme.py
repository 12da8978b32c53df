"""The README's snippets run as they stand."""

import re
from pathlib import Path

import pytest

README = (Path(__file__).resolve().parents[2] / "README.md").read_text(encoding="utf-8")
SNIPPETS = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)
PREAMBLE = "import gymnasium as gym\nimport numpy as np\nimport seal_gym\n"


def test_there_are_snippets():
    assert len(SNIPPETS) >= 3


@pytest.mark.parametrize("k", range(len(SNIPPETS)))
def test_snippet_runs(k, capsys):
    exec(compile(PREAMBLE + SNIPPETS[k], f"README snippet {k}", "exec"), {"__name__": "snippet"})
    if "outcome" in SNIPPETS[k]:
        assert capsys.readouterr().out.strip() == "reached"
