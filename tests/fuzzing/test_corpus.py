"""The corpus kept by ``run.py``: bytes that reach different code, and former failures."""

from pathlib import Path

import pytest
from fuzzing.targets import TARGETS

CORPUS = Path(__file__).parent / "corpus"


@pytest.mark.parametrize("name", TARGETS)
def test_fuzzing_corpus_passes_every_target(name: str) -> None:
    files = sorted((CORPUS / name).iterdir())
    assert len(files) > 5
    for file in files:
        TARGETS[name](file.read_bytes())
