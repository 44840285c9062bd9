from scripts.reports.run import report

report("diffnet", "table")
