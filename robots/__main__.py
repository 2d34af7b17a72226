"""`python -m robots` is the `robots` command."""

from robots.cli import main

main()
