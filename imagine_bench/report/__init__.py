"""What a bench found, for a person who did not run it: data, words, plots, the page."""

from imagine_bench.report.page import summary_table, write_report

__all__ = ["summary_table", "write_report"]
