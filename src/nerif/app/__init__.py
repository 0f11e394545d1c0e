"""All steps from design to results in a browser, on the user's own machine: `nerif app`."""
