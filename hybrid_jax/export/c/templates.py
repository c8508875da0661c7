"""The text of the header and of the source of `export_c` and `export_adaptation_c`, as `string.Template`."""


def _header(about: str, definitions: str, functions: str) -> str:
    return f"""\
/* {about} */
#ifndef ${{NAME}}_H
#define ${{NAME}}_H

#define ${{NAME}}_STATE_SIZE $d
#define ${{NAME}}_INPUT_SIZE $m
{definitions}

#ifdef __cplusplus
extern "C" {{
#endif

{functions}

#ifdef __cplusplus
}}
#endif
#endif
"""


_BEGINNING = """\
/* See $name.h; written by hybrid_jax. */
#include "$name.h"

#include <math.h>

typedef $type real;

$tables

$helpers
"""

_MODEL = (
    """A model dx/dt = f(x, u), written by hybrid_jax.
$about

   Matrices are in row-major order: dx[i][j] is the derivative of entry i of the result by x[j].
   No function allocates, keeps a state or changes what it reads; results must not overlap what is read.
   A number that is not finite in x or u goes on into the result: test it there.""",
    "#define ${NAME}_DT $dt /* length of a step [s] */",
    """/* dx/dt at the state x under the input u. */
void ${name}_derivative(const $type x[$d], const $type u[$m], $type xdot[$d]);

/* The state ${NAME}_DT after x with u held: one step of the classical Runge-Kutta method of order 4.
   Quaternions are not normalised. */
void ${name}_step(const $type x[$d], const $type u[$m], $type next[$d]);

/* As ${name}_derivative, with its Jacobians. */
void ${name}_derivative_jacobian(const $type x[$d], const $type u[$m], $type xdot[$d],
                                 $type dx[$d][$d], $type du[$d][$m]);

/* As ${name}_step, with its Jacobians. */
void ${name}_step_jacobian(const $type x[$d], const $type u[$m], $type next[$d],
                           $type dx[$d][$d], $type du[$d][$m]);""",
)
HEADER = _header(*_MODEL)
PAST_HEADER = _header(
    *_MODEL[:2],
    _MODEL[2]
    + """

/* The state ${NAME}_DT after x with u held, where its first $n numbers were measured. The last $hidden are filtered
   errors of the model: 0 at the first sample, and then what this function returns, which you carry on. */
void ${name}_observe(const $type x[$d], const $type u[$m], const $type measured[$n], $type next[$d]);""",
)

SOURCE = (
    _BEGINNING
    + """\
enum { D = $d, M = $m, C = D + M };

static void derivative(const real *x, const real *u, real *xdot) {
    (void)x;
    (void)u;
$values
}

/* dx/dt, and its Jacobian in x and u, of $d rows. */
static void slopes(const real *x, const real *u, real *xdot, real *jacobian) {
    (void)x;
    (void)u;
$slopes
}

/* dx/dt of a state x that depends on where the step began and on u by s. */
static void directions(const real *x, const real *s, const real *u, real *xdot, real *ds) {
    real jacobian[D * C];
    slopes(x, u, xdot, jacobian);
    for (int i = 0; i < D; ++i) {
        real *row = ds + i * C;
        for (int j = 0; j < D; ++j) { row[j] = 0; }
        for (int j = D; j < C; ++j) { row[j] = jacobian[i * C + j]; }
        for (int l = 0; l < D; ++l) {
            const real factor = jacobian[i * C + l];
            if (factor != 0) {
                for (int j = 0; j < C; ++j) { row[j] += factor * s[l * C + j]; }
            }
        }
    }
}

/* a + h b, of n numbers. */
static void shifted(const real *a, real h, const real *b, real *out, int n) {
    for (int i = 0; i < n; ++i) { out[i] = a[i] + h * b[i]; }
}

#define H ($dt / 2)
static const real WEIGHT[4] = {1, 2, 2, 1}, AHEAD[4] = {H, H, 2 * H, 0};

void ${name}_derivative(const real x[D], const real u[M], real xdot[D]) { derivative(x, u, xdot); }

void ${name}_step(const real x[D], const real u[M], real next[D]) {
    real k[D], y[D], sum[D];
    for (int i = 0; i < D; ++i) { y[i] = x[i]; sum[i] = 0; }
    for (int stage = 0; stage < 4; ++stage) {
        derivative(y, u, k);
        shifted(sum, WEIGHT[stage], k, sum, D);
        shifted(x, AHEAD[stage], k, y, D);
    }
    shifted(x, H / 3, sum, next, D);
}

static void split(const real *both, real dx[D][D], real du[D][M]) {
    for (int i = 0; i < D; ++i) {
        for (int j = 0; j < D; ++j) { dx[i][j] = both[i * C + j]; }
        for (int j = 0; j < M; ++j) { du[i][j] = both[i * C + D + j]; }
    }
}

void ${name}_derivative_jacobian(const real x[D], const real u[M], real xdot[D], real dx[D][D], real du[D][M]) {
    real both[D * C];
    slopes(x, u, xdot, both);
    split(both, dx, du);
}

/* The derivative of a Runge-Kutta step is a step of the same method along the directions. */
void ${name}_step_jacobian(const real x[D], const real u[M], real next[D], real dx[D][D], real du[D][M]) {
    real k[D], y[D], sum[D], dk[D * C], s[D * C], total[D * C];
    for (int i = 0; i < D; ++i) { y[i] = x[i]; sum[i] = 0; }
    for (int i = 0; i < D * C; ++i) { s[i] = i % C == i / C; total[i] = 0; }
    for (int stage = 0; stage < 4; ++stage) {
        directions(y, s, u, k, dk);
        shifted(sum, WEIGHT[stage], k, sum, D);
        shifted(total, WEIGHT[stage], dk, total, D * C);
        shifted(x, AHEAD[stage], k, y, D);
        for (int i = 0; i < D * C; ++i) { s[i] = (real)(i % C == i / C) + AHEAD[stage] * dk[i]; }
    }
    shifted(x, H / 3, sum, next, D);
    for (int i = 0; i < D * C; ++i) { s[i] = (real)(i % C == i / C) + H / 3 * total[i]; }
    split(s, dx, du);
}
"""
)

OBSERVE = """
void ${name}_observe(const real x[D], const real u[M], const real measured[$n], real next[D]) {
    (void)u;
$observe
}
"""

ADAPTATION_HEADER = _header(
    """A filter that adapts a model while it runs, written by hybrid_jax.

   state: $layout.
   theta holds the changes of $names,
   in the standard deviations of their prior.
   No function allocates or keeps a state; results must not overlap what is read.""",
    """\
#define ${NAME}_PARAMETERS $p
#define ${NAME}_SIZE $size /* of the filter's state */
#define ${NAME}_TRUSTED $trusted /* where the last good theta begins in it */
#define ${NAME}_DT $dt /* time between two samples [s] */""",
    """\
/* The state of the filter before the first sample x. */
void ${name}_begin(const $type x[$d], $type state[$size]);

/* After a sample x, NaN where nothing was measured, and the mean input u since the last update, $elapsed. */
void ${name}_update(const $type state[$size], const $type x[$d], const $type u[$m], $type periods,
                    $type next[$size]);""",
)

ADAPTATION_SOURCE = (
    _BEGINNING
    + """\
void ${name}_begin(const real x[$d], real state[$size]) {
$begin
}

void ${name}_update(const real state[$size], const real x[$d], const real u[$m], real periods, real next[$size]) {
    const real elapsed[1] = {periods};
    (void)elapsed;
$update
}
"""
)
