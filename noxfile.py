"""The tests on each Python: `nox` runs those interpreters that are installed, `nox -s tests-3.12` one of them.

Wheels of torch, numba and pybullet exist for x86-64 and aarch64 Linux; only x86-64 has been run.
"""

import nox

PYTHONS = ("3.10", "3.11", "3.12", "3.13")
PINNED = "3.11"  # constraints.txt was resolved for it
# The last jaxtyping for it checks compiled functions, too, although they are marked not to be.
UNCHECKED = "3.10"

nox.options.error_on_missing_interpreters = False


@nox.session(python=PYTHONS)
def tests(session: nox.Session) -> None:
    """Install the package with all extras and run the quick tests."""
    pins = ("--constraint", "constraints.txt") if session.python == PINNED else ()
    session.install(*pins, ".[dev]")
    checks = ("--jaxtyping-packages=",) if session.python == UNCHECKED else ()
    session.run("python", "-m", "pytest", *checks, *session.posargs)


@nox.session(python=PYTHONS)
def core(session: nox.Session) -> None:
    """Install what maps and plans alone, and do both: no simulator, no solver."""
    pins = ("--constraint", "constraints.txt") if session.python == PINNED else ()
    session.install(*pins, ".")
    session.run("python", "-m", "tests.core_install")
    session.run("isdf", "--help", silent=True)
