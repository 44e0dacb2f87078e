"""Files of data sets, of scenes or of episodes."""

from __future__ import annotations

from pathlib import Path

from capsense._validate import read_toml
from capsense.errors import ScenarioError
from capsense.learning import episodes, scenes
from capsense.learning.shards import DataSet


def load_data_set(path: str | Path) -> DataSet:
    """Load the file of a data set: of episodes if it names an ``environment``, else of scenes.

    Raises:
        ScenarioError: There is no such file, or anything in it is wrong.
        DesignError: Something is wrong in the design file it names.
        MissingDependencyError: Episodes need Gymnasium and MuJoCo.
    """
    kind = read_toml(Path(path), "data set", ScenarioError)
    return episodes.load_episodes(path) if "environment" in kind else scenes.load_spec(path)
