"""Quality of rendered views: metrics, baselines, targets and reports, on cameras, rigs and (h, w, 3) images."""
