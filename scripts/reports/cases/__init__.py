"""The cases of all reports, a module each: what is measured, by which function, beside which number."""
