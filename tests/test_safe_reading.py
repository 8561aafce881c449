"""No source file may read code from data."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
_MODULES = {"pickle", "cPickle", "cloudpickle", "dill", "joblib", "shelve", "marshal", "yaml"}
_HARMLESS = {"joblib": {"Parallel", "delayed", "parallel_config"}}
"""Of these modules: what spreads work over processes and reads no file."""
_BUILTINS = {"eval", "exec", "compile", "__import__"}


def violations(source: str) -> list[str]:
    """Return what in a Python source can run code that it has read."""
    found = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names if alias.name.split(".")[0] in _MODULES]
        elif isinstance(node, ast.ImportFrom):
            module = node.module or ""
            harmless = {alias.name for alias in node.names} <= _HARMLESS.get(module, set())
            found += [module] if module.split(".")[0] in _MODULES and not harmless else []
            loaders = [alias.name for alias in node.names if alias.name == "load"]
            found += loaders if module in ("torch", "numpy") else []
        elif isinstance(node, ast.Call):
            called, options = ast.unparse(node.func), {option.arg: option.value for option in node.keywords}
            pickles = options.get("allow_pickle")
            safe = isinstance(pickles, ast.Constant) and pickles.value is False
            loads = re.fullmatch(
                r"(torch|th|yaml|\w*(PPO|SAC|Policy|Algorithm|Normalize|model|policy|env)\w*)\.load", called
            )
            reads = called in ("np.load", "numpy.load")
            if called in _BUILTINS or loads or (reads and not safe) or ("allow_pickle" in options and not safe):
                found.append(called)
            if called.rsplit(".", maxsplit=1)[-1] in ("set_parameters", "load_replay_buffer", "unpickle", "run_path"):
                found.append(called)
    return found


def test_no_source_file_runs_what_it_reads() -> None:
    files = [path for pattern in ("agents/**/*.py", "magenv/**/*.py", "*.py") for path in ROOT.glob(pattern)]
    assert len(files) > 30
    assert {path.name: found for path in files if (found := violations(path.read_text()))} == {}


@pytest.mark.parametrize(
    "line",
    [
        "import pickle",
        "from pickle import loads",
        "import yaml as y",
        "import joblib",
        "from joblib import load, Parallel",
        "from joblib import Memory",
        "torch.load(path)",
        "from torch import load",
        "np.load(path)",
        "np.load(path, allow_pickle=True)",
        "np.savez(path, allow_pickle=flag)",
        "PPO.load(path)",
        "VecNormalize.load(path, env)",
        "model.load(path)",
        "policy = PPOPolicy.load(path)",
        "eval(text)",
        "exec(text)",
        "model.set_parameters(path)",
    ],
)
def test_the_scan_sees(line: str) -> None:
    assert violations(line)


def test_the_scan_lets_safe_readers_pass() -> None:
    safe = ["np.load(f, allow_pickle=False)", "load_file(p)", "json.loads(t)", "re.compile(p)", "policy.load_card(p)"]
    safe.append("from joblib import Parallel, delayed")
    assert not [line for line in safe if violations(line)]
