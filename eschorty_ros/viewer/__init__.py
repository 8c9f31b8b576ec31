"""The page in the browser: what it shows, when it may start a scan, and its server."""
