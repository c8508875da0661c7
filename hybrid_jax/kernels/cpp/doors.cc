// Handlers that wait until those of a library are behind them, which is compiled while XLA compiles what calls them.

#include <unistd.h>

#include <utility>

#include "arrays.h"

using Handler = XLA_FFI_Error* (*)(XLA_FFI_CallFrame*);
constexpr int COUNT = 128;
extern "C" {
Handler behind[COUNT];

XLA_FFI_Error* refuse(XLA_FFI_CallFrame* frame) {
  const char* why = "the kernel of a field could not be compiled; HYBRID_JAX_NATIVE=0 does without kernels";
  XLA_FFI_Error_Create_Args error{XLA_FFI_Error_Create_Args_STRUCT_SIZE, nullptr, why, XLA_FFI_Error_Code_INTERNAL};
  return frame->api->XLA_FFI_Error_Create(&error);
}
}

template <int I>
XLA_FFI_Error* door(XLA_FFI_CallFrame* frame) {
  if (is_answered(frame)) return nullptr;
  while (!__atomic_load_n(&behind[I], __ATOMIC_ACQUIRE)) usleep(500);
  return behind[I](frame);
}

template <int... I>
Handler door_of(int i, std::integer_sequence<int, I...>) {
  const Handler doors[] = {door<I>...};
  return doors[i];
}
extern "C" Handler door_at(int i) { return i < COUNT ? door_of(i, std::make_integer_sequence<int, COUNT>{}) : nullptr; }
