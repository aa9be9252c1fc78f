// A page that was opened from a folder may not read the others for excerpts: without them, the
// search still works there.
if (location.protocol === "file:") DOCUMENTATION_OPTIONS.SHOW_SEARCH_SUMMARY = false;
