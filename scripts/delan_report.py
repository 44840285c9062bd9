from scripts.reports.run import report

report("arm", "published", "letters", "speeds")
