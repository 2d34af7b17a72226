"""The packages do not know each other, import lightly, have no import cycles and do not print."""

from __future__ import annotations

import ast
import importlib.util
import os
import subprocess
import sys
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ("isdf", "planning", "robots")
OUTSIDE = ("examples", "benchmarks", "tests")


def sources(root: Path, package: str) -> dict[str, Path]:
    """Files of a package by module name."""
    found = {}
    for path in sorted((root / package).rglob("*.py")):
        parts = path.relative_to(root).with_suffix("").parts
        found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


def imported(nodes, module: str, is_package: bool, known: set[str]) -> set[str]:
    """Modules that import statements among `nodes` name; of a `known` package, the submodule if it is one."""
    names = set()
    base = module if is_package else module.rpartition(".")[0]
    for node in nodes:
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            source = node.module or ""
            if node.level:
                source = importlib.util.resolve_name("." * node.level + source, base)
            for alias in node.names:
                inner = f"{source}.{alias.name}"
                names.add(inner if inner in known else source)
    return names


def everywhere(tree: ast.Module) -> list[ast.AST]:
    """All statements, those inside functions included."""
    return list(ast.walk(tree))


def when_loaded(tree: ast.AST) -> list[ast.AST]:
    """Statements that run on import: not those in functions, nor those for type checkers only."""
    found: list[ast.AST] = []
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            continue
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            continue
        found += [node, *when_loaded(node)]
    return found


def import_graph(root: Path, package: str, statements) -> dict[str, set[str]]:
    files = sources(root, package)
    return {
        name: imported(statements(ast.parse(path.read_text())), name, path.name == "__init__.py", set(files))
        for name, path in files.items()
    }


def cycle(graph: dict[str, set[str]]) -> list[str] | None:
    """Modules of one import cycle, if there is any."""
    inner = {name: {target for target in targets if target in graph} for name, targets in graph.items()}
    try:
        list(TopologicalSorter(inner).static_order())
    except CycleError as error:
        return list(error.args[1])
    return None


def prints(path: Path) -> list[int]:
    calls = (node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Call))
    return [call.lineno for call in calls if isinstance(call.func, ast.Name) and call.func.id == "print"]


@pytest.mark.parametrize("package", PACKAGES)
def test_packages_never_import_one_another(package: str) -> None:
    graph = import_graph(ROOT, package, everywhere)
    assert graph, f"no sources of {package} in {ROOT}"
    others = {*PACKAGES, *OUTSIDE} - {package}
    for module, targets in graph.items():
        foreign = sorted(target for target in targets if target.partition(".")[0] in others)
        assert not foreign, f"{module} imports {foreign}"


@pytest.mark.parametrize("package", PACKAGES)
def test_no_import_cycles(package: str) -> None:
    found = cycle(import_graph(ROOT, package, when_loaded))
    assert found is None, " -> ".join(found or [])


@pytest.mark.parametrize("package", PACKAGES)
def test_libraries_do_not_print(package: str) -> None:
    talking = {
        name: lines
        for name, path in sources(ROOT, package).items()
        if path.name != "cli.py" and (lines := prints(path))
    }
    assert not talking, f"print in {talking}; use logging"


WINDOWS = {"tkinter", "pyglet", "viser", "cv2", "open3d", "matplotlib.pyplot", "OpenGL", "PyQt5", "PySide6"}


@pytest.mark.parametrize(
    ("package", "unwanted"),
    [
        ("isdf", {"pybullet", "casadi", "pytorch_kinematics", "planning", "robots"} | WINDOWS),
        ("planning", {"pybullet", "casadi", "numba", "pytorch_kinematics", "isdf", "robots"} | WINDOWS),
        # pytorch_kinematics loads pyplot, which opens no window by that.
        (
            "robots",
            {"pybullet", "casadi", "robots.simulation", "isdf", "planning"} | WINDOWS - {"matplotlib.pyplot"},
        ),
    ],
)
def test_importing_a_package_loads_nothing_optional(package: str, unwanted: set[str]) -> None:
    code = f"import sys, {package}; print(*sys.modules, sep='\\n')"
    run = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    loaded = set(run.stdout.split("\n"))
    assert package in loaded and "torch" in loaded
    assert not (found := loaded & unwanted), f"import {package} loads {sorted(found)}"


def test_mapping_and_planning_need_no_optional_package() -> None:
    """`nox -s core` does the same in an environment that has none of them."""
    command = [sys.executable, "-m", "tests.core_install", "--blocked"]
    run = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr


MEASURE = """
import time, torch
start = time.process_time()
import isdf
print(time.process_time() - start)
import sys
from numba.core.dispatcher import Dispatcher
modules = [m for name, m in sys.modules.items() if name.partition(".")[0] == "isdf"]
kernels = {id(v): v for m in modules for v in vars(m).values() if isinstance(v, Dispatcher)}
print(len(kernels), sum(len(k.signatures) for k in kernels.values()))
print(*sorted({"matplotlib", "skimage", "trimesh", "PIL", "tyro", "hypothesis"} & set(sys.modules)))
isdf.GridField(torch.rand(4, 4, 4), torch.zeros(3), 0.1)._repr_png_()
import matplotlib
untouched = dict.__getitem__(matplotlib.rcParams, "backend") is matplotlib.rcsetup._auto_backend_sentinel
print(untouched and "matplotlib.pyplot" not in sys.modules)
"""


def test_importing_isdf_is_quick_and_compiles_nothing() -> None:
    """Beyond torch's own import, in CPU seconds; drawing, meshing and the command line load when they are used."""
    run = subprocess.run(
        [sys.executable, "-c", MEASURE],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
        env={name: value for name, value in os.environ.items() if name != "MPLBACKEND"},
    )
    seconds, kernels, loaded, untouched = run.stdout.split("\n")[:4]
    assert float(seconds) < 1.5
    count, compiled = map(int, kernels.split())
    assert count > 5 and compiled == 0
    assert loaded == ""
    assert untouched == "True", "drawing in a notebook leaves its backend alone"


def careless(tree: ast.AST) -> list[int]:
    """Lines of numba decorators that compile on import, do not keep their code on the disk, or stop other threads."""
    bad = []
    for node in ast.walk(tree):
        for decorator in node.decorator_list if isinstance(node, ast.FunctionDef) else ():
            called = decorator.func if isinstance(decorator, ast.Call) else decorator
            if ast.unparse(called).split(".")[-1] not in ("njit", "jit", "vectorize", "guvectorize"):
                continue
            keywords = {k.arg: ast.unparse(k.value) for k in getattr(decorator, "keywords", [])}
            kept, free = keywords.get("cache") == "True", keywords.get("nogil") == "True"
            if not (kept and free) or getattr(decorator, "args", []):
                bad.append(decorator.lineno)
    return bad


@pytest.mark.parametrize("package", PACKAGES)
def test_compiled_code_is_kept_between_runs_and_lets_other_threads_run(package: str) -> None:
    found = {n: careless(ast.parse(path.read_text())) for n, path in sources(ROOT, package).items()}
    assert not {name: lines for name, lines in found.items() if lines}
    good = "cache=True, nogil=True"
    decorators = ("njit", f"njit({good})", f"nb.njit('f8(f8)', {good})", "njit(cache=True)")
    text = "".join(f"@{one}\ndef f(): pass\n" for one in decorators)
    assert careless(ast.parse(text)) == [1, 5, 7]


def runs_as_a_file(tree: ast.Module) -> bool:
    """Whether a script finds its neighbours when Python is given its path instead of -m and its name."""
    path_set = False
    for node in when_loaded(tree):
        path_set |= isinstance(node, ast.If) and ast.unparse(node.test) == "not __package__"
        needed = {name.partition(".")[0] for name in imported([node], "script", False, set())}
        if needed & set(OUTSIDE) and not path_set:
            return False
    return True


@pytest.mark.parametrize("folder", ["examples", "benchmarks"])
def test_scripts_run_as_files(folder: str) -> None:
    scripts = {n: t for n, p in sources(ROOT, folder).items() if "__main__" in (t := p.read_text())}
    assert len(scripts) > 5
    assert not [name for name, text in scripts.items() if not runs_as_a_file(ast.parse(text))]


def test_the_checks_see_what_they_look_for(tmp_path) -> None:
    files = {
        "isdf/__init__.py": "from .a import f\n",
        "isdf/a.py": "from . import b\ndef f():\n    import planning.chomp\n",
        "isdf/b.py": (
            "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from .c import C\ntry:\n    import json\n"
            "except ImportError:\n    print('no')\n"
        ),
        "isdf/c.py": "class C:\n    from isdf.sub.d import e\n",
        "isdf/sub/__init__.py": "",
        "isdf/sub/d.py": "from .. import a as e\n",
    }
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    loaded = import_graph(tmp_path, "isdf", when_loaded)
    assert loaded["isdf"] == {"isdf.a"} and loaded["isdf.a"] == {"isdf.b"}
    assert loaded["isdf.b"] == {"typing", "json"}
    assert loaded["isdf.c"] == {"isdf.sub.d"} and loaded["isdf.sub.d"] == {"isdf.a"}
    assert cycle(loaded) is None
    assert "planning.chomp" in import_graph(tmp_path, "isdf", everywhere)["isdf.a"]
    assert prints(tmp_path / "isdf/b.py") == [7]
    (tmp_path / "isdf/b.py").write_text("from isdf.c import C\n")
    found = cycle(import_graph(tmp_path, "isdf", when_loaded))
    assert found and {"isdf.a", "isdf.b", "isdf.c", "isdf.sub.d"} == set(found)
