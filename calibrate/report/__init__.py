"""The report: one self-contained HTML page for people, the verdict first. No network, no scripts."""
