// ẋ of a rigid body carried by its rotors plus a residual, and the derivative, as `RigidBody` has it.
//
// Columns lie along the vectors. The order of all sums depends on the sizes alone, so that a lane of a sweep is the
// same run alone. There are at least V columns, which the caller sees to, as to all shapes.

#pragma once

#include "vectors.h"

namespace {

constexpr int STATE = 13, BEFORE_ROTORS = 4, OF_ROTOR = 3;

enum Number { DT, EPSILON, CONSTANTS };  // the numbers of a call begin with dt and ε
using Constants = Numbers;  // m, g, Iz, c_m and, for each rotor, its x, y and spin; or nothing

// θ_p, and b columns of x (13, b) and u (rotors, b).
struct Body {
  float ix, iy, k;
  const float *constants, *x, *u;
  int64_t b, rotors;

  Body(const float* theta, Constants constants, const float* x, const float* u, int64_t b)
      : ix(theta[0]), iy(theta[1]), k(theta[2]), constants(constants.at), x(x), u(u), b(b),
        rotors((constants.size - BEFORE_ROTORS) / OF_ROTOR) {}

  float mass() const { return constants[0]; }
  float gravity() const { return constants[1]; }
  float iz() const { return constants[2]; }
  float moment() const { return constants[3]; }
  const float* rotor(int64_t i) const { return constants + BEFORE_ROTORS + OF_ROTOR * i; }
};

// V columns from `at` on.
struct Columns {
  Vec w, x, y, z, a, b, c;  // q and ω
  Vec total, moment_x, moment_y, spin;  // Σ u², Σ x u², Σ y u², Σ ± u² of the rotors
  Vec acceleration, up[3];  // of the thrust, which is along `up`
  Vec turning[3];  // ω̇

  INLINE Columns(const Body& body, int64_t at) : total{}, moment_x{}, moment_y{}, spin{} {
    auto row = [&](int i) { return load(body.x + i * body.b + at); };
    w = row(3), x = row(4), y = row(5), z = row(6), a = row(10), b = row(11), c = row(12);
    for (int64_t i = 0; i < body.rotors; ++i) {
      const Vec speed = load(body.u + i * body.b + at), square = speed * speed;
      const float* rotor = body.rotor(i);
      total += square, moment_x += rotor[0] * square, moment_y += rotor[1] * square, spin += rotor[2] * square;
    }
    acceleration = body.k / body.mass() * total;
    up[0] = 2 * (x * z + w * y), up[1] = 2 * (y * z - w * x), up[2] = w * w - x * x - y * y + z * z;
    turning[0] = (body.k * moment_y - (body.iz() - body.iy) * b * c) * (1 / body.ix);
    turning[1] = (-body.k * moment_x - (body.ix - body.iz()) * c * a) * (1 / body.iy);
    turning[2] = (body.moment() * spin - (body.iy - body.ix) * a * b) * (1 / body.iz());
  }
};

void forward_columns(const Body& body, const float* residual, float* out) {
  for (int64_t i = 0; i < body.b; i += V) {
    const int64_t at = first(i, body.b);
    auto row = [&](int r, Vec own) { store(out + r * body.b + at, own + load(residual + r * body.b + at)); };
    const Columns s(body, at);
    for (int r = 0; r < 3; ++r) {
      row(r, load(body.x + (7 + r) * body.b + at));
      row(7 + r, s.acceleration * s.up[r] - (r == 2 ? body.gravity() : 0.0f));
      row(10 + r, s.turning[r]);
    }
    row(3, 0.5f * (-s.x * s.a - s.y * s.b - s.z * s.c));
    row(4, 0.5f * (s.w * s.a + s.y * s.c - s.z * s.b));
    row(5, 0.5f * (s.w * s.b + s.z * s.a - s.x * s.c));
    row(6, 0.5f * (s.w * s.c + s.x * s.b - s.y * s.a));
  }
}

// Stores the derivatives with respect to x and u, and adds those with respect to Ix, Iy and k.
void backward_columns(const Body& body, const float* d_out, float* d_x, float* d_u, float* d_theta) {
  Vec d_ix{}, d_iy{}, d_k{};
  for (int64_t i = 0; i < body.b; i += V) {
    const int64_t at = first(i, body.b);
    auto d = [&](int r) { return load(d_out + r * body.b + at); };
    auto to = [&](int r) { return d_x + r * body.b + at; };
    const Columns s(body, at);
    for (int r = 0; r < 3; ++r) store(to(r), Vec{}), store(to(7 + r), d(r));
    const Vec dw = 0.5f * d(3), dx = 0.5f * d(4), dy = 0.5f * d(5), dz = 0.5f * d(6);
    const Vec up_x = 2 * s.acceleration * d(7), up_y = 2 * s.acceleration * d(8), up_z = 2 * s.acceleration * d(9);
    store(to(3), up_x * s.y - up_y * s.x + up_z * s.w + (dx * s.a + dy * s.b + dz * s.c));
    store(to(4), up_x * s.z - up_y * s.w - up_z * s.x + (dz * s.b - dw * s.a - dy * s.c));
    store(to(5), up_x * s.w + up_y * s.z - up_z * s.y + (dx * s.c - dw * s.b - dz * s.a));
    store(to(6), up_x * s.x + up_y * s.y + up_z * s.z + (dy * s.a - dw * s.c - dx * s.b));
    const Vec tx = d(10) * (1 / body.ix), ty = d(11) * (1 / body.iy), tz = d(12) * (1 / body.iz());
    const Vec gx = (body.iz() - body.iy) * tx, gy = (body.ix - body.iz()) * ty, gz = (body.iy - body.ix) * tz;
    store(to(10), dx * s.w + dy * s.z - dz * s.y - dw * s.x - (gy * s.c + gz * s.b));
    store(to(11), dy * s.w + dz * s.x - dw * s.y - dx * s.z - (gx * s.c + gz * s.a));
    store(to(12), dz * s.w + dx * s.y - dy * s.x - dw * s.z - (gx * s.b + gy * s.a));
    const Vec d_acceleration = d(7) * s.up[0] + d(8) * s.up[1] + d(9) * s.up[2];
    const Vec by_total = body.k / body.mass() * d_acceleration;
    for (int64_t j = 0; j < body.rotors; ++j) {
      const float* rotor = body.rotor(j);
      const Vec by_square = by_total + body.k * (rotor[1] * tx - rotor[0] * ty) + body.moment() * rotor[2] * tz;
      store(d_u + j * body.b + at, 2 * load(body.u + j * body.b + at) * by_square);
    }
    const Vec ab = s.a * s.b, bc = s.b * s.c, ca = s.c * s.a;
    auto add = [&](Vec& all, Vec part) { all += without(part, i - at); };  // no column twice
    add(d_ix, tz * ab - ty * ca - tx * s.turning[0]);
    add(d_iy, tx * bc - tz * ab - ty * s.turning[1]);
    add(d_k, d_acceleration * s.total * (1 / body.mass()) + tx * s.moment_y - ty * s.moment_x);
  }
  d_theta[0] += sum(d_ix), d_theta[1] += sum(d_iy), d_theta[2] += sum(d_k);
}

}  // namespace
