"""Finished runs as evidence: pooled over seeds, and shown as tables, figures and a page."""
