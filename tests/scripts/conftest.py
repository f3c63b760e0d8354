import pytest

from studies.comparison import jobs
from tests.scripts.fakes import FakeAgent, fake_baseline


@pytest.fixture
def fake_agents(monkeypatch: pytest.MonkeyPatch) -> None:
    """Replaces the agent and the training of baselines by fast stand-ins with poor policies."""
    monkeypatch.setattr(jobs, "ModelLearningAgent", FakeAgent)
    monkeypatch.setattr(jobs, "train_baseline", fake_baseline)
