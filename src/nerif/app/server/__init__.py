"""The server of the app: address, access, responses."""
