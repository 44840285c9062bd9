from scripts.reports.run import report

report("benchmark")
