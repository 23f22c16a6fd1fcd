// Jobs that run in parallel.
//
// Every job writes its own part of the output. Where floats are summed, the division into jobs does
// not depend on the number of threads. The result is then bitwise equal for any number of threads.
#pragma once
#include <pthread.h>
#include <unistd.h>

#include <algorithm>
#include <atomic>
#include <condition_variable>
#include <csignal>
#include <cstdint>
#include <mutex>
#include <system_error>
#include <thread>
#include <vector>

namespace ldo::LDO_ISA {

// Jobs of one call, called a round. Each thread takes the next job until none is left. A seat is a
// place for one helper thread in the round.
class Round {
 public:
  template <class F>
  Round(int64_t jobs, const F& f)
      : call_([](const void* function, int64_t job) { (*static_cast<const F*>(function))(job); }),
        function_(&f),
        jobs_(jobs) {}

  void work() {
    for (int64_t job; (job = next_.fetch_add(1, std::memory_order_relaxed)) < jobs_;)
      call_(function_, job);
  }

 private:
  friend class Helpers;
  void (*const call_)(const void* function, int64_t job);
  const void* const function_;
  const int64_t jobs_;
  std::atomic<int64_t> next_{0};
  std::atomic<int> working_{0};  // Helpers at work.
  int seats_ = 0;                // Seats that no helper has taken yet.
  std::condition_variable left_;
};

// Helper threads that take part in the rounds of every call in this process, and block between
// rounds. Their number grows to the largest number of seats that are open at the same time.
class Helpers {
 public:
  // Return the helpers of this process. A forked child process has none of the threads of its
  // parent and creates new helpers. The object is never destroyed, because the helper threads use
  // it until the process ends.
  static Helpers& of_this_process() {
    static std::atomic<Helpers*> known{nullptr};
    Helpers* helpers = known;
    while (helpers == nullptr || helpers->process_ != getpid()) {
      Helpers* fresh = new Helpers;
      if (known.compare_exchange_strong(helpers, fresh)) return *fresh;
      delete fresh;  // Another thread was faster.
    }
    return *helpers;
  }

  void open(Round& round, int seats) {
    {
      const std::lock_guard<std::mutex> lock(mutex_);
      rounds_.push_back(&round);
      round.seats_ = seats;
      seats_ += seats;
      while (idle_ < seats_ && start_one()) {
      }
    }
    for (int i = 0; i < seats; ++i) opened_.notify_one();
  }

  // Wait until the helpers that took a seat are done, and close the round, so that no other helper
  // can take a seat.
  void close(Round& round) {
    yield_while([&] { return round.working_ > 0; });
    std::unique_lock<std::mutex> lock(mutex_);
    rounds_.erase(std::find(rounds_.begin(), rounds_.end(), &round));
    seats_ -= round.seats_;
    round.left_.wait(lock, [&] { return round.working_ == 0; });
  }

 private:
  // Start a helper. Return false if the system cannot create more threads; the existing threads
  // then do all the work.
  bool start_one() {
    sigset_t every, before;  // Python's threads handle all signals.
    sigfillset(&every);
    pthread_sigmask(SIG_SETMASK, &every, &before);
    bool is_started = true;
    try {
      std::thread([this] { help(); }).detach();
      ++idle_;
    } catch (const std::system_error&) {
      is_started = false;
    }
    pthread_sigmask(SIG_SETMASK, &before, nullptr);
    return is_started;
  }

  void help() {
    for (;;) {
      yield_while([this] { return seats_ == 0; });
      std::unique_lock<std::mutex> lock(mutex_);
      opened_.wait(lock, [this] { return seats_ > 0; });
      Round& round = take_seat();
      lock.unlock();
      round.work();
      lock.lock();
      ++idle_;
      if (--round.working_ == 0) round.left_.notify_one();
    }
  }

  Round& take_seat() {
    Round& round = **std::find_if(rounds_.begin(), rounds_.end(),
                                  [](const Round* open) { return open->seats_ > 0; });
    --idle_;
    --seats_;
    --round.seats_;
    ++round.working_;
    return round;
  }

  // Yield while the condition holds, at most 1024 times. The next round usually starts within a few
  // microseconds, and blocking takes longer.
  template <class Condition>
  static void yield_while(Condition condition) {
    for (int i = 0; i < 1024 && condition(); ++i) std::this_thread::yield();
  }

  const pid_t process_ = getpid();
  std::mutex mutex_;
  std::condition_variable opened_;
  std::vector<Round*> rounds_;
  std::atomic<int> seats_{0};  // Open seats of all rounds.
  int idle_ = 0;               // Helpers without work.
};

// Threads of one call, the caller included.
class Team {
 public:
  explicit Team(int threads) : size_(threads) {}
  int size() const { return size_; }

  // Call f(job) for every job in [0, jobs) and return when all are done. f must not throw.
  template <class F>
  void each(int64_t jobs, const F& f) {
    const int64_t seats = std::min<int64_t>(size_, jobs) - 1;
    if (seats <= 0) {
      for (int64_t job = 0; job < jobs; ++job) f(job);
      return;
    }
    Round round(jobs, f);
    Helpers& helpers = Helpers::of_this_process();
    helpers.open(round, static_cast<int>(seats));
    round.work();
    helpers.close(round);
  }

 private:
  const int size_;
};

}  // namespace ldo::LDO_ISA
