"""The command line as tests call it in their own process."""

from amiwarp.cli.app import app as app
