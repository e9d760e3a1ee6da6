"""README's results, the HTML report, and pages that hold whole files of results/."""
