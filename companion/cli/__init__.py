"""The console command ``companion``: one file per command."""
