"""Reads finished runs, pools them over seeds, and shows them as tables, figures and a page."""
