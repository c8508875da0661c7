"""The keys of models, modes and domains in results and caches, and their labels for readers."""

HYBRID, NO_PHYSICS, PHYSICS_ONLY = "hybrid", "no_physics", "physics_only"
EXPERT_AUGMENTATION, LAST_LAYER, LINEAR_RESIDUAL = "expert_augmentation", "last_layer", "linear_residual"
THETA_P_ONLY, THETA_D_ONLY = "theta_p_only", "theta_d_only"
LEAST_SQUARES, CONSTANT_DISTURBANCE = "least_squares", "constant_disturbance"
THRUST, HOLD, CHOSEN = "thrust", "hold", "chosen"
FINE_TUNED, TARGET_ONLY, SOURCE_ONLY = "fine_tuned", "target_only", "source_only"
SCRATCH = "scratch"
UNCHANGED, PARAMETER_SHIFT, EXTERNAL_FORCE = "source", "parameter_shift", "external_force"
LABELS = {
    HYBRID: "hybrid",
    NO_PHYSICS: "no-physics",
    PHYSICS_ONLY: "physics-only",
    EXPERT_AUGMENTATION: "Expert Augmentation",
    THETA_P_ONLY: "θ_p only",
    THETA_D_ONLY: "θ_d only",
    LAST_LAYER: "last layer (ridge)",
    LEAST_SQUARES: "least squares on θ_p",
    CONSTANT_DISTURBANCE: "hj.adapt (θ_p + disturbance)",
    LINEAR_RESIDUAL: "source + linear residual",
    THRUST: "thrust, rates frozen",
    HOLD: "constant state",
    CHOSEN: "chosen",
    FINE_TUNED: "fine-tuned",
    TARGET_ONLY: "target-only",
    SOURCE_ONLY: "source-only",
    UNCHANGED: "unchanged vehicle",
    PARAMETER_SHIFT: "other inertia",
    EXTERNAL_FORCE: "side wind",
    "doubled_drag": "twice the drag",
    "weak_rotor": "one rotor 15 % weaker",
    "off_centre_load": "load off centre",
    "gusty_wind": "gusty wind",
    "load_and_wind": "load and wind",
    "reaction_torque": "other reaction torque",
    "motor_lag": "slower motors",
    "battery": "weaker battery",
    "nothing": "no change",
    "moving": "usual flight",
    "near_ground": "near the ground",
    "short": "three seconds",
    "noisy": "three times the noise",
    "outliers": "usual flight with outliers",
    "iris": "Iris (our simulator)",
    "hummingbird": "Hummingbird (RotorPy)",
    "crazyflie": "Crazyflie (RotorPy)",
}


def label(*keys: str) -> str:
    """Join the labels of keys by commas; a key without a label is its own label."""
    return ", ".join(LABELS.get(key, key) for key in keys)
