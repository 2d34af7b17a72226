"""`python -m isdf` is the `isdf` command."""

from .cli import main

main()
