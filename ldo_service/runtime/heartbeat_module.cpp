// Heartbeat of a process from a thread that never needs the GIL.

#include <nanobind/nanobind.h>
#include <unistd.h>

#include <atomic>
#include <chrono>
#include <condition_variable>
#include <mutex>
#include <stdexcept>
#include <thread>

namespace nb = nanobind;

namespace {

double now_s() {
  using namespace std::chrono;
  return duration<double>(steady_clock::now().time_since_epoch()).count();
}

// Thread that periodically writes the age of the current step to a file descriptor. The age is a
// double in seconds, and 0 between steps.
class Heartbeat {
 public:
  Heartbeat(int fd, double period_s) : fd_(fd), period_s_(period_s) {
    if (fd < 0 || !(period_s > 0.0)) {
      throw std::invalid_argument("fd must not be negative and period_s must be positive");
    }
    thread_ = std::thread([this] { run(); });
  }

  ~Heartbeat() { stop(); }

  void begin() { began_s_ = now_s(); }

  void end() { began_s_ = 0.0; }

  void stop() {
    {
      const std::lock_guard<std::mutex> lock(mutex_);
      stopped_ = true;
    }
    changed_.notify_all();
    if (thread_.joinable()) {
      thread_.join();
    }
  }

 private:
  void run() {
    std::unique_lock<std::mutex> lock(mutex_);
    while (!stopped_) {
      const double began_s = began_s_;
      const double age_s = began_s > 0.0 ? now_s() - began_s : 0.0;
      // The descriptor does not block. A heartbeat is skipped if it cannot be written without
      // waiting or has no reader.
      [[maybe_unused]] const ssize_t written = ::write(fd_, &age_s, sizeof(age_s));
      changed_.wait_for(lock, std::chrono::duration<double>(period_s_));
    }
  }

  const int fd_;
  const double period_s_;
  std::atomic<double> began_s_{0.0};
  bool stopped_ = false;
  std::mutex mutex_;
  std::condition_variable changed_;
  std::thread thread_;
};

}  // namespace

NB_MODULE(_heartbeat, module) {
  nb::class_<Heartbeat>(module, "Heartbeat")
      .def(nb::init<int, double>(), nb::arg("fd"), nb::arg("period_s"))
      .def("begin", &Heartbeat::begin)
      .def("end", &Heartbeat::end)
      .def("stop", &Heartbeat::stop, nb::call_guard<nb::gil_scoped_release>());
}
