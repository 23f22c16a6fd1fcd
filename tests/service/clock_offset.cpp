// Library for LD_PRELOAD: adds an offset to the wall clock of a program. The file that the variable
// CLOCK_OFFSET_FILE names contains the offset, an int64 in seconds. Monotonic clocks do not change.
#include <dlfcn.h>
#include <fcntl.h>
#include <sys/mman.h>
#include <sys/time.h>
#include <time.h>
#include <unistd.h>

#include <cstdint>
#include <cstdlib>

namespace {

// Offset, seconds. The mapping of the file shows each change at once.
int64_t offset_s() {
  static const volatile int64_t* const shared = [] {
    static const int64_t none = 0;
    const char* path = getenv("CLOCK_OFFSET_FILE");
    const int file = path ? open(path, O_RDONLY | O_CLOEXEC) : -1;
    if (file < 0) return &none;
    void* at = mmap(nullptr, sizeof(int64_t), PROT_READ, MAP_SHARED, file, 0);
    close(file);
    return at == MAP_FAILED ? &none : static_cast<const int64_t*>(at);
  }();
  return *shared;
}

template <typename Function>
Function* next(const char* name) {
  return reinterpret_cast<Function*>(dlsym(RTLD_NEXT, name));
}

}  // namespace

extern "C" {

int clock_gettime(clockid_t clock, struct timespec* now) noexcept {
  static const auto real = next<int(clockid_t, struct timespec*)>("clock_gettime");
  const int failed = real(clock, now);
  if (!failed && (clock == CLOCK_REALTIME || clock == CLOCK_REALTIME_COARSE)) {
    now->tv_sec += offset_s();
  }
  return failed;
}

int gettimeofday(struct timeval* __restrict now, void* __restrict zone) noexcept {
  static const auto real = next<int(struct timeval*, void*)>("gettimeofday");
  const int failed = real(now, zone);
  if (!failed) now->tv_sec += offset_s();
  return failed;
}

time_t time(time_t* now) noexcept {
  static const auto real = next<time_t(time_t*)>("time");
  const time_t shown = real(nullptr) + offset_s();
  if (now) *now = shown;
  return shown;
}

}  // extern "C"
