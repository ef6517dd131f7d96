"""The room from bags and from the running launch: path, fence, targets, and where things stand now."""
