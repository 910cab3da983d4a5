"""`casacal bench`: public data sets, each split several ways, and methods judged on rows they have not seen."""
