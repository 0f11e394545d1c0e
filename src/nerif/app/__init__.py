"""The whole road in a browser, on the lab's own machine: `nerif app`."""
