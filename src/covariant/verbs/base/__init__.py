"""What verbs share, in the order in which a verb uses it.

- Arguments and files: `arguments`, `inputs` (model and log as they are read), `kind` and `kinds` (all that depends on
  the kind of model), `sensors`, `holes`, `sheet` (noise), `placeholders`, `coordinates`, `scenario`, `simulated_log`.
- Work: `design` (an observer from a data sheet), `fit_logs` and `fit_to_logs`, `aligned`, `tune_to_logs`, `find` (a
  certificate), `trial`, `without_model`, `servo_draft`, `designed_excitation`, `exported_program`, `robot_file`.
- Outcome: `outcome` (the run of an observer), `estimates`, `determined`, `bands`, `refusals`, `among_logs`.
- Output: `result`, `outputs` (tables and figures), `pages`, `recording`, `progress`, `model_text` and `model_output`.
"""
