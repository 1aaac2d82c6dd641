"""The report: one self-contained HTML page for people, the verdict first. No network, no scripts."""

from calibrate.report.page import report_page, write_report

__all__ = ["report_page", "write_report"]
