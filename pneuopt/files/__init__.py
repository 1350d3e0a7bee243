"""TOML files."""
