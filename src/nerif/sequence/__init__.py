"""Many frames: a store of results, frames that start from one another, and the cluster they run on."""
