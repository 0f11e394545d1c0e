"""The paper's numerical study: what it reconstructs, running it, and the page it makes."""
