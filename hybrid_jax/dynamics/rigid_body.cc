// ẋ of a rigid body carried by its rotors plus a residual, and the derivative: `RigidBody.train_sum`, each in one call,
// in single precision.
//
// Columns lie along the vectors. The order of all sums depends on the sizes alone, so that a lane of a sweep is the
// same run alone. There are at least V columns, which the caller sees to, as to all shapes.

#include "vectors.h"

namespace {

using Constants = ffi::Span<const float>;

constexpr int STATE = 13, BEFORE_ROTORS = 4, OF_ROTOR = 3;

// A lane: its θ_p, and b columns of x (13, b) and u (rotors, b). `constants` are m, g, Iz, c_m and, for each rotor, its
// x, y and spin.
struct Lane {
  float ix, iy, k;
  const float *x, *u, *constants;
  int64_t b, rotors;

  float mass() const { return constants[0]; }
  float gravity() const { return constants[1]; }
  float iz() const { return constants[2]; }
  float moment() const { return constants[3]; }
  const float* rotor(int64_t i) const { return constants + BEFORE_ROTORS + OF_ROTOR * i; }
};

// V columns of a lane from `at` on.
struct Columns {
  Vec w, x, y, z, a, b, c;  // q and ω
  Vec total, moment_x, moment_y, spin;  // Σ u², Σ x u², Σ y u², Σ ± u² of the rotors
  Vec acceleration, up[3];  // of the thrust, which is along `up`
  Vec turning[3];  // ω̇

  INLINE Columns(const Lane& lane, int64_t at) : total{}, moment_x{}, moment_y{}, spin{} {
    auto row = [&](int i) { return load(lane.x + i * lane.b + at); };
    w = row(3), x = row(4), y = row(5), z = row(6), a = row(10), b = row(11), c = row(12);
    for (int64_t i = 0; i < lane.rotors; ++i) {
      const Vec speed = load(lane.u + i * lane.b + at), square = speed * speed;
      const float* rotor = lane.rotor(i);
      total += square, moment_x += rotor[0] * square, moment_y += rotor[1] * square, spin += rotor[2] * square;
    }
    acceleration = lane.k / lane.mass() * total;
    up[0] = 2 * (x * z + w * y), up[1] = 2 * (y * z - w * x), up[2] = w * w - x * x - y * y + z * z;
    turning[0] = (lane.k * moment_y - (lane.iz() - lane.iy) * b * c) * (1 / lane.ix);
    turning[1] = (-lane.k * moment_x - (lane.ix - lane.iz()) * c * a) * (1 / lane.iy);
    turning[2] = (lane.moment() * spin - (lane.iy - lane.ix) * a * b) * (1 / lane.iz());
  }
};

void forward_lane(const Lane& lane, const float* residual, float* out) {
  for (int64_t i = 0; i < lane.b; i += V) {
    const int64_t at = first(i, lane.b);
    auto row = [&](int r, Vec own) { store(out + r * lane.b + at, own + load(residual + r * lane.b + at)); };
    const Columns s(lane, at);
    for (int r = 0; r < 3; ++r) {
      row(r, load(lane.x + (7 + r) * lane.b + at));
      row(7 + r, s.acceleration * s.up[r] - (r == 2 ? lane.gravity() : 0.0f));
      row(10 + r, s.turning[r]);
    }
    row(3, 0.5f * (-s.x * s.a - s.y * s.b - s.z * s.c));
    row(4, 0.5f * (s.w * s.a + s.y * s.c - s.z * s.b));
    row(5, 0.5f * (s.w * s.b + s.z * s.a - s.x * s.c));
    row(6, 0.5f * (s.w * s.c + s.x * s.b - s.y * s.a));
  }
}

struct Sums { float ix, iy, k; };

Sums backward_lane(const Lane& lane, const float* d_out, float* d_x, float* d_u) {
  Vec d_ix{}, d_iy{}, d_k{};
  for (int64_t i = 0; i < lane.b; i += V) {
    const int64_t at = first(i, lane.b);
    auto d = [&](int r) { return load(d_out + r * lane.b + at); };
    auto to = [&](int r) { return d_x + r * lane.b + at; };
    const Columns s(lane, at);
    for (int r = 0; r < 3; ++r) store(to(r), Vec{}), store(to(7 + r), d(r));
    const Vec dw = 0.5f * d(3), dx = 0.5f * d(4), dy = 0.5f * d(5), dz = 0.5f * d(6);
    const Vec up_x = 2 * s.acceleration * d(7), up_y = 2 * s.acceleration * d(8), up_z = 2 * s.acceleration * d(9);
    store(to(3), up_x * s.y - up_y * s.x + up_z * s.w + (dx * s.a + dy * s.b + dz * s.c));
    store(to(4), up_x * s.z - up_y * s.w - up_z * s.x + (dz * s.b - dw * s.a - dy * s.c));
    store(to(5), up_x * s.w + up_y * s.z - up_z * s.y + (dx * s.c - dw * s.b - dz * s.a));
    store(to(6), up_x * s.x + up_y * s.y + up_z * s.z + (dy * s.a - dw * s.c - dx * s.b));
    const Vec tx = d(10) * (1 / lane.ix), ty = d(11) * (1 / lane.iy), tz = d(12) * (1 / lane.iz());
    const Vec gx = (lane.iz() - lane.iy) * tx, gy = (lane.ix - lane.iz()) * ty, gz = (lane.iy - lane.ix) * tz;
    store(to(10), dx * s.w + dy * s.z - dz * s.y - dw * s.x - (gy * s.c + gz * s.b));
    store(to(11), dy * s.w + dz * s.x - dw * s.y - dx * s.z - (gx * s.c + gz * s.a));
    store(to(12), dz * s.w + dx * s.y - dy * s.x - dw * s.z - (gx * s.b + gy * s.a));
    const Vec d_acceleration = d(7) * s.up[0] + d(8) * s.up[1] + d(9) * s.up[2];
    const Vec by_total = lane.k / lane.mass() * d_acceleration;
    for (int64_t j = 0; j < lane.rotors; ++j) {
      const float* rotor = lane.rotor(j);
      const Vec by_square = by_total + lane.k * (rotor[1] * tx - rotor[0] * ty) + lane.moment() * rotor[2] * tz;
      store(d_u + j * lane.b + at, 2 * load(lane.u + j * lane.b + at) * by_square);
    }
    const Vec ab = s.a * s.b, bc = s.b * s.c, ca = s.c * s.a;
    auto add = [&](Vec& all, Vec part) { all += without(part, i - at); };  // no column twice
    add(d_ix, tz * ab - ty * ca - tx * s.turning[0]);
    add(d_iy, tx * bc - tz * ab - ty * s.turning[1]);
    add(d_k, d_acceleration * s.total * (1 / lane.mass()) + tx * s.moment_y - ty * s.moment_x);
  }
  return {sum(d_ix), sum(d_iy), sum(d_k)};
}

Lane lane_of(Constants constants, const Array& ix, const Array& iy, const Array& k, const Array& x, const Array& u,
             int64_t lane) {
  const int64_t b = x.dimensions().back(), rotors = (constants.size() - BEFORE_ROTORS) / OF_ROTOR;
  return {ix.typed_data()[lane], iy.typed_data()[lane], k.typed_data()[lane], x.typed_data() + lane * STATE * b,
          u.typed_data() + lane * rotors * b, constants.begin(), b, rotors};
}

ffi::Error forward_call(Constants constants, Array ix, Array iy, Array k, Array x, Array u, Array residual,
                        Result out) {
  for (int64_t i = 0; i < int64_t(ix.element_count()); ++i) {
    const Lane lane = lane_of(constants, ix, iy, k, x, u, i);
    const int64_t at = i * STATE * lane.b;
    forward_lane(lane, residual.typed_data() + at, out->typed_data() + at);
  }
  return ffi::Error::Success();
}

ffi::Error backward_call(Constants constants, Array ix, Array iy, Array k, Array x, Array u, Array d_out, Result d_ix,
                         Result d_iy, Result d_k, Result d_x, Result d_u) {
  for (int64_t i = 0; i < int64_t(ix.element_count()); ++i) {
    const Lane lane = lane_of(constants, ix, iy, k, x, u, i);
    const int64_t at = i * STATE * lane.b;
    const Sums sums = backward_lane(lane, d_out.typed_data() + at, d_x->typed_data() + at,
                                    d_u->typed_data() + i * lane.rotors * lane.b);
    d_ix->typed_data()[i] = sums.ix, d_iy->typed_data()[i] = sums.iy, d_k->typed_data()[i] = sums.k;
  }
  return ffi::Error::Success();
}

}  // namespace

#define FIVE(KIND) .KIND<Array>().KIND<Array>().KIND<Array>().KIND<Array>().KIND<Array>()
XLA_FFI_DEFINE_HANDLER_SYMBOL(rigid_body_forward, forward_call,
                              ffi::Ffi::Bind().Attr<Constants>("constants") FIVE(Arg).Arg<Array>().Ret<Array>());
XLA_FFI_DEFINE_HANDLER_SYMBOL(rigid_body_backward, backward_call,
                              ffi::Ffi::Bind().Attr<Constants>("constants") FIVE(Arg).Arg<Array>() FIVE(Ret));
