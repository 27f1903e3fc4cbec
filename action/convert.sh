#!/usr/bin/env bash
# The step of action.yml that does the work: converts, and leaves the table in a file and in the run's summary.
# FOLDER, TO, TIME and OUTPUT are the action's inputs; RUNNER_TEMP, GITHUB_OUTPUT and GITHUB_STEP_SUMMARY are given.
set -euo pipefail
here=$(cd "$(dirname "$0")" && pwd)
table="$RUNNER_TEMP/sizes.md"
only=()
# Without a pull request all scenes of the folder are converted.
[ -f "$RUNNER_TEMP/changed.txt" ] && only=(--only "$RUNNER_TEMP/changed.txt")
echo "table=$table" >> "$GITHUB_OUTPUT"
status=0
python "$here/../tools/convert_folder.py" "$FOLDER" -o "$OUTPUT" --to "$TO" --time "$TIME" \
	${only[@]+"${only[@]}"} > "$table" || status=$?
cat "$table" >> "$GITHUB_STEP_SUMMARY"
exit "$status"
