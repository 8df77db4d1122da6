"""The uncertainty report for cut safety: content once, as HTML, PDF and JSON."""
