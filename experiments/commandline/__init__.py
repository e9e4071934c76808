"""Command lines: flags, presets, YAML files of settings, messages."""
