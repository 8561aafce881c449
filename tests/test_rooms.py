"""Who may import whom, and what an environment loads."""

from __future__ import annotations

import ast
import importlib.util
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import magenv

PACKAGE = Path(magenv.__file__).parent
ORDER = [
    "params",
    "files",
    "command",
    "origin",
    "kernels",
    "arithmetic",
    "angles",
    "workers",
    "dipole",
    "cylinder",
    "poses",
    "margins",
    "wrench",
    "stiffness",
    "outcome",
    "spheres",
    "cholesky",
    "descent",
    "interior",
    "solver",
    "allocation_scipy",
    "allocation_input",
    "allocation",
    "crosstalk.activation",
    "crosstalk.frontier",
    "crosstalk.holdable",
    "crosstalk.stability",
    "crosstalk.validity",
    "crosstalk",
    "crosstalk.tasks",
    "crosstalk.sweep",
    "crosstalk.plan",
    "crosstalk.style",
    "crosstalk.panel_figures",
    "crosstalk.atlas_figures",
    "crosstalk.figures",
    "crosstalk.__main__",
    "streams",
    "random_knots",
    "shape_knots",
    "trajectories",
    "lanes",
    "magnets",
    "dynamics",
    "ways",
    "reach",
    "travel",
    "sensitivity",
    "local",
    "forecast",
    "manoeuvre",
    "risk",
    "postures",
    "horizon",
    "observer",
    "hold",
    "world",
    "home",
    "linear_hold",
    "calm_holds",
    "steering_cost",
    "steering",
    "calm_search",
    "velocity",
    "actions",
    "task",
    "starts",
    "uncertainty",
    "state",
    "steps",
    "episodes",
    "episode",
    "scene",
    "canvas",
    "render",
    "env",
    "vector_env",
]
"""Each module imports only from those before it; ``kernels`` says how to compile and stands at the very beginning."""
FILES = {
    ".".join(path.relative_to(PACKAGE).with_suffix("").parts).removesuffix(".__init__"): path
    for path in sorted(PACKAGE.rglob("*.py"))
}
MODULES = sorted(set(FILES) - {"__init__"})


def imports(path: Path) -> set[str]:
    """Return the absolute names of all modules that a file imports, at any depth of its code."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path.name} has a relative import"
            assert node.module is not None
            found.add(node.module)
            if node.module == "magenv":
                found |= {f"magenv.{alias.name}" for alias in node.names}
    return found


def test_every_module_has_a_room() -> None:
    assert set(MODULES) <= set(ORDER)
    assert len(set(ORDER)) == len(ORDER)


@pytest.mark.parametrize("module", MODULES)
def test_modules_import_only_from_above(module: str) -> None:
    allowed = {f"magenv.{name}" for name in ORDER[: ORDER.index(module)]} | {"magenv"}
    own = {name for name in imports(FILES[module]) if name.split(".")[0] == "magenv"}
    assert own <= allowed


@pytest.mark.parametrize("module", [*MODULES, "__init__"])
def test_magenv_never_imports_agents_nor_what_learns_or_plots(module: str) -> None:
    names = {name.split(".")[0] for name in imports(FILES[module])}
    forbidden = {"agents", "torch", "stable_baselines3", "matplotlib"}
    draws = {f"crosstalk.{name}" for name in ("style", "panel_figures", "atlas_figures", "figures")}
    assert not names & (forbidden - {"matplotlib"} if module in draws else forbidden)
    assert "pygame" not in names or module in ("canvas", "render")


@pytest.mark.parametrize("action", ["home", "wrench"])
def test_env_loads_neither_torch_nor_pictures(action: str) -> None:
    """In a process of its own: make, reset and step the scalar and the batched environment."""
    code = f"""
import sys
import gymnasium, numpy, magenv
env = gymnasium.make("magenv/TwoRobots-v0", action="{action}", render_mode="rgb_array")
env.reset(seed=0)
env.step(env.action_space.sample())
env.close()
batch = gymnasium.make_vec(
    "magenv/TwoRobots-v0", num_envs=2, vectorization_mode="vector_entry_point", action="{action}")
batch.reset(seed=0)
batch.step(batch.action_space.sample())
batch.close()
print(sorted({{name.split(".")[0] for name in sys.modules}} & {{
    "agents", "torch", "matplotlib", "pygame", "stable_baselines3", "pandas", "tensorboard", "magpylib"}}))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=PACKAGE.parent)
    assert done.stdout.strip() == "[]"
    assert done.stderr == ""


def test_torch_is_for_training_alone() -> None:
    learns = {"torch", "stable_baselines3"}
    agents = PACKAGE.parent / "agents"
    found = {
        ".".join(path.relative_to(agents).with_suffix("").parts)
        for path in agents.rglob("*.py")
        if learns & {name.split(".")[0] for name in imports(path)}
    }
    assert found == {
        "networks",
        "sb3_vec",
        "residual_vec",
        "history_vec",
        "curriculum",
        "cloning",
        "checkpoints",
        "keeper",
        "progress",
        "learning",
        "study.work",
    }


def test_importing_the_package_registers_the_env_alone() -> None:
    code = "import sys, magenv; print(sorted(n for n in sys.modules if n.startswith('magenv.')))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=PACKAGE.parent)
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize("changed", ["dipole.py", "params.py", "kernels.py"])
def test_compiled_kernels_are_renewed_when_what_they_hold_changes(tmp_path: Path, changed: str) -> None:
    """Constants of other modules, mu0 of ``params`` among them, are frozen in machine code: no change may go unseen."""
    shutil.copytree(PACKAGE, tmp_path / "magenv", ignore=shutil.ignore_patterns("__pycache__"))
    folders = []
    for text in ("", "\nCHANGED = 1\n"):
        with (tmp_path / "magenv" / changed).open("a", encoding="utf-8") as file:
            file.write(text)
        spec = importlib.util.spec_from_file_location("copied_kernels", tmp_path / "magenv" / "kernels.py")
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        folders.append(module._CACHE_DIR)
    assert folders[0] != folders[1]
