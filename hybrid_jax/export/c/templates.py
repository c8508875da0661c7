"""The text of the header and of the source of `export_c`, as `string.Template`."""

HEADER = """\
/* A model dx/dt = f(x, u), written by hybrid_jax.
$about

   Matrices are in row-major order: dx[i][j] is the derivative of entry i of the result by x[j].
   No function allocates, keeps a state or changes what it reads; results must not overlap what is read.
   A number that is not finite in x or u goes on into the result: test it there. */
#ifndef ${NAME}_H
#define ${NAME}_H

#define ${NAME}_STATE_SIZE $d
#define ${NAME}_INPUT_SIZE $m
#define ${NAME}_DT $dt /* length of a step [s] */

#ifdef __cplusplus
extern "C" {
#endif

/* dx/dt at the state x under the input u. */
void ${name}_derivative(const $type x[$d], const $type u[$m], $type xdot[$d]);

/* The state ${NAME}_DT after x with u held: one step of the classical Runge-Kutta method of order 4.
   Quaternions are not normalised. */
void ${name}_step(const $type x[$d], const $type u[$m], $type next[$d]);

/* As ${name}_derivative, with its Jacobians. */
void ${name}_derivative_jacobian(const $type x[$d], const $type u[$m], $type xdot[$d],
                                 $type dx[$d][$d], $type du[$d][$m]);

/* As ${name}_step, with its Jacobians. */
void ${name}_step_jacobian(const $type x[$d], const $type u[$m], $type next[$d],
                           $type dx[$d][$d], $type du[$d][$m]);

#ifdef __cplusplus
}
#endif
#endif
"""

SOURCE = """\
/* See $name.h; written by hybrid_jax. */
#include "$name.h"

#include <math.h>

typedef $type real;

enum { D = $d, M = $m, C = D + M };

$tables

$helpers
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

static const real H = $dt / 2;

void ${name}_derivative(const real x[D], const real u[M], real xdot[D]) { derivative(x, u, xdot); }

void ${name}_step(const real x[D], const real u[M], real next[D]) {
    real k[D], y[D], sum[D];
    derivative(x, u, sum);
    shifted(x, H, sum, y, D);
    derivative(y, u, k);
    shifted(sum, 2, k, sum, D);
    shifted(x, H, k, y, D);
    derivative(y, u, k);
    shifted(sum, 2, k, sum, D);
    shifted(x, 2 * H, k, y, D);
    derivative(y, u, k);
    for (int i = 0; i < D; ++i) { next[i] = x[i] + H / 3 * (sum[i] + k[i]); }
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
    const real weight[4] = {1, 2, 2, 1}, ahead[4] = {H, H, 2 * H, 0};
    real k[D], y[D], sum[D], dk[D * C], s[D * C], total[D * C];
    for (int i = 0; i < D; ++i) { y[i] = x[i]; sum[i] = 0; }
    for (int i = 0; i < D * C; ++i) { s[i] = i % C == i / C; total[i] = 0; }
    for (int stage = 0; stage < 4; ++stage) {
        directions(y, s, u, k, dk);
        shifted(sum, weight[stage], k, sum, D);
        shifted(total, weight[stage], dk, total, D * C);
        shifted(x, ahead[stage], k, y, D);
        for (int i = 0; i < D * C; ++i) { s[i] = (real)(i % C == i / C) + ahead[stage] * dk[i]; }
    }
    shifted(x, H / 3, sum, next, D);
    for (int i = 0; i < D * C; ++i) { s[i] = (real)(i % C == i / C) + H / 3 * total[i]; }
    split(s, dx, du);
}
"""
